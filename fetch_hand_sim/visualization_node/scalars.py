"""Numbers of a tick for plots."""

from __future__ import annotations

from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.view.robot_watch import SeenTick
from msgs_spec.cdr import TopicCodec
from msgs_spec.tasks import SuccessRule, TaskSpec
from msgs_spec.topics import scalar_topics


class Scalars:
    """Encodes the topics `scalars/*` of one task."""

    def __init__(self, spec: TaskSpec, success_rule: SuccessRule) -> None:
        self._metric = GoalMetric(spec, success_rule=success_rule)
        self._codecs = {source.name: TopicCodec(source) for source in scalar_topics(spec)}

    def messages(self, tick: SeenTick) -> dict[str, bytes]:
        """Return the CDR bytes of each topic; a reset has no reward."""
        frame = tick.frame
        distance, rotation = self._metric.distances(frame.achieved_goal, frame.desired_goal)
        numbers = {
            'distance': float(distance),
            'rotation': float(rotation),
            'reward': tick.reward,
            'is_success': float(frame.is_success),
        }
        found = {}
        for name, codec in self._codecs.items():
            number = numbers[codec.topic.layout[0].name]
            if number is not None:
                found[name] = codec.encode(tick.stamp_ns, [number])
        return found
