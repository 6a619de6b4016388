"""What every episode of a running robot has in common in its log."""

from __future__ import annotations

from datetime import UTC, datetime

from fetch_hand_sim.episode_log import Attachment, episode_metadata
from fetch_hand_sim.episode_log.model import compiled_attachment, mjcf_attachment, model_sha256
from fetch_hand_sim.simulation import Simulation
from msgs_spec.tick import EpisodeStatus
from node_runtime.source_revision import source_revision


class RecordingContext:
    """Makes metadata and attachments for the episodes of one simulation.

    Args:
        simulation: Whose episodes are logged.
        with_compiled_model: Whether to store the compiled model, meshes and all, 3 MB per
            episode; its MJCF text is stored in any case.
        perturb_limit: Largest force, N, by which the robot lets itself be pushed.

    Attributes:
        attachments: The model, stored with every episode.
        checkpoint_sha256: Fingerprint of the actor that commands the robot, if one told.
    """

    def __init__(
        self,
        simulation: Simulation,
        *,
        with_compiled_model: bool = True,
        perturb_limit: float = 0.0,
    ) -> None:
        self._simulation = simulation
        self._perturb_limit = perturb_limit
        self._model_sha256 = model_sha256(simulation.model)
        # Asked for now: it starts a process, which can hold up a robot that runs.
        self._source_revision = source_revision()
        self.attachments: list[Attachment] = [mjcf_attachment(simulation.asset)]
        if with_compiled_model:
            self.attachments.append(compiled_attachment(simulation.model))
        self.checkpoint_sha256: str | None = None

    def metadata(self, status: EpisodeStatus) -> dict[str, str]:
        """Returns the metadata record `episode` for an episode with this first status."""
        return episode_metadata(
            self._simulation.spec.with_joint_prefix(status.joint_prefix),
            episode=status.episode,
            seed=status.seed,
            reward_type=status.reward_type,
            success_rule=status.success_rule,
            control_hz=status.control_hz,
            timing=self._simulation.timing,
            joint_prefix=status.joint_prefix,
            model_sha256=self._model_sha256,
            source_revision=self._source_revision,
            checkpoint_sha256=self.checkpoint_sha256,
            perturb_limit=self._perturb_limit,
            disturbances=status.disturbances,
            variation=status.variation,
            started=datetime.now(UTC).isoformat(timespec='milliseconds'),
        )
