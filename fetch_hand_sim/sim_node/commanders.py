"""Who publishes commands, as the graph tells it: newcomers, duplicates, those never heard."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass


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
    """Compares what the graph shows now with what it showed before."""

    def __init__(self, type_names: Mapping[str, str]) -> None:
        """Starts with nobody.

        Args:
            type_names: Fully qualified topics that carry commands, with their types.
        """
        self._type_names = type_names
        self._known: dict[bytes, Endpoint] = {}

    @property
    def names(self) -> list[str]:
        """Nodes whose commands this robot receives; one that runs twice is named twice."""
        publishers: Counter[str] = Counter()
        for topic in self._type_names:
            heard = (each for each in self._known.values() if not self._deafness(each))
            publishers |= Counter(each.node for each in heard if each.topic == topic)
        return sorted(publishers.elements())

    def look(self, found: Iterable[Endpoint]) -> bool:
        """Takes what the graph shows now.

        Returns:
            Whether somebody came who was not there before.
        """
        before = self._known.keys()
        self._known = {endpoint.gid: endpoint for endpoint in found}
        return bool(self._known.keys() - before)

    def problems(self) -> list[str]:
        """What is wrong with the commanders, a line each."""
        problems = []
        if len(self.names) > 1:
            problems.append(f'{len(self.names)} publish commands: {", ".join(self.names)}')
        for endpoint in self._known.values():
            reason = self._deafness(endpoint)
            if reason:
                problems.append(f'{endpoint.topic} of {endpoint.node} is not received: {reason}')
        return problems

    def _deafness(self, endpoint: Endpoint) -> str:
        """Why messages of a publisher never arrive, or ''."""
        if endpoint.type_name != self._type_names[endpoint.topic]:
            return f'its type is {endpoint.type_name}'
        return '' if endpoint.is_reliable else 'it is best effort; offer reliable'
