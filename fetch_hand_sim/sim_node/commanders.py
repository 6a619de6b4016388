"""Who publishes commands, as the graph tells it: newcomers, duplicates, those never heard."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from node_runtime.ros import MEMORY_OF_THE_GRAPH


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A publisher found on the graph.

    Attributes:
        node: Fully qualified name of its node.
        topic: What it publishes, fully qualified.
        type_name: Type of the messages.
        is_reliable: Whether it offers reliable delivery.
        gid: Identity of the publisher.
    """

    node: str
    topic: str
    type_name: str
    is_reliable: bool
    gid: bytes


class CommanderWatch:
    """Compares what the graph shows now with what it showed before.

    Args:
        type_names: Fully qualified topics that carry commands, with their types.
    """

    def __init__(self, type_names: Mapping[str, str]) -> None:
        self._type_names = type_names
        self._endpoints: list[Endpoint] = []
        self._since: dict[bytes, float] = {}
        self._now = 0.0

    @property
    def names(self) -> list[str]:
        """Nodes whose commands this robot receives; one that runs twice is named twice."""
        copies: dict[str, int] = {}
        for topic in self._type_names:
            for node in {endpoint.node for endpoint in self._endpoints}:
                copies[node] = max(copies.get(node, 0), self._copies(node, topic))
        return sorted(name for name, count in copies.items() for _ in range(count))

    def update(self, found: Iterable[Endpoint], now: float) -> bool:
        """Takes what the graph shows now.

        Args:
            found: Publishers of topics that carry commands.
            now: Seconds of a steady clock.

        Returns:
            Whether somebody came who was not there before.
        """
        known = self._since
        self._endpoints, self._now = list(found), now
        self._since = {each.gid: known.get(each.gid, now) for each in self._endpoints}
        return bool(self._since.keys() - known.keys())

    def problems(self) -> list[str]:
        """What is wrong with the commanders, a line each."""
        problems = []
        if len(self.names) > 1:
            problems.append(f'{len(self.names)} publish commands: {", ".join(self.names)}')
        for endpoint in self._endpoints:
            reason = self._why_unheard(endpoint)
            if reason:
                problems.append(f'{endpoint.topic} of {endpoint.node} is not received: {reason}')
        return problems

    def _copies(self, node: str, topic: str) -> int:
        """How many processes of this name publish a topic.

        One that was killed and its successor count as one.
        """
        heard = [
            self._now - self._since[each.gid]
            for each in self._endpoints
            if (each.node, each.topic) == (node, topic) and not self._why_unheard(each)
        ]
        return len(heard) if heard and min(heard) > MEMORY_OF_THE_GRAPH else min(len(heard), 1)

    def _why_unheard(self, endpoint: Endpoint) -> str:
        """Why messages of a publisher never arrive, or ''."""
        if endpoint.type_name != self._type_names[endpoint.topic]:
            return f'its type is {endpoint.type_name}'
        return '' if endpoint.is_reliable else 'it is best effort; offer reliable'
