"""The fields of a training configuration."""

from __future__ import annotations

from dataclasses import dataclass

from msgs_spec.tasks import DEFAULT_CONTROL_HZ


@dataclass(frozen=True, slots=True)
class ConfigFields:
    """The fields of `TrainConfig`, whatever their values.

    `num_envs`, `batch_size` and `replay_transitions` are totals: with N workers each takes its
    share, so the `paper` recipe on 19 workers is the paper's set-up worker by worker.
    """

    task: str
    """Task name, `FetchReach`, ..."""
    recipe: str = 'best'
    """Recipe the values come from, for the record."""
    seed: int = 0
    """Seed of weights, exploration, relabelling and resets."""
    algorithm: str = 'ddpg'
    """`ddpg`, or `ppo` (on policy: each cycle's episodes once, also under goals in hindsight)."""
    control_hz: float = DEFAULT_CONTROL_HZ
    """Action frequency, Hz. Steps, also those of this configuration, are ticks at this rate."""
    disturbances: str = ''
    """Disturbances of the simulated robot: a preset, `hardware*0.5`, a file or JSON."""
    past_actions: int = 0
    """Number of past actions that the networks see."""
    reward_type: str = 'sparse'
    """`sparse` (-1 until success, then 0) or `dense` (negative distance)."""
    success_rule: str = 'gymnasium'
    """Success rule behind the sparse reward: `gymnasium` or `paper`."""
    gamble: bool = False
    """The idle gripper action above .9 teleports the achieved goal at random and freezes the
    episode (FetchReach, FetchPush): the paper's own case against hindsight."""
    reward_distance: float = 1.0
    """Share of the task's success distance within which the sparse reward of training is 0. Below 1
    the actor learns to come closer than it has to; evaluation keeps the task's distance."""
    reward_rotation: float = 1.0
    """Share of the task's success rotation likewise."""
    first_distance: float = 1.0
    """What `reward_distance` is multiplied by at the start of the run; this factor falls
    geometrically to 1 over the first two thirds. Coarse goals, which are met often, come first."""
    first_rotation: float = 1.0
    """What `reward_rotation` is multiplied by at the start, likewise."""
    narrow_above: float = 0.0
    """Share of a cycle's episodes that must end in success, by goals as coarse as they are then,
    for these to narrow on; steps of other cycles do not count towards it. 0 never waits."""
    reward_grades: str = ''
    """Multiples of the success thresholds, as `.5,1,2,4`: the sparse reward of training becomes the
    share of them within which the distance is, times that of the rotation, minus 1."""
    reward_apart: float = 0.0
    """Share of the graded reward in which distance and rotation add up instead of multiplying, so
    that each is worth something without the other."""
    strategy: str = 'future'
    """Hindsight goals: final, future, episode, random, futureactual, or none (no hindsight)."""
    hindsight_k: int = 4
    """Relabelled goals for each goal kept, so k/(k+1) of a batch is relabelled; of `ppo` also where
    `goals` says which: there its shares count among each other."""
    goals: str = ''
    """Goal sources as a mixture instead of `strategy`: `future=.4,actual=.3,near=.1`; what is left
    of 1 keeps the goal. Also `next` (what this step achieved), `near` (one of the next
    ten) and `displaced` (near what was achieved before it); of `ppo` also `outcome` (what other
    episodes brought about, from where this one began)."""
    retry_failed: float = 0.0
    """Share of the episodes whose goal is one that an earlier episode, with a goal as the task
    draws it, failed to meet: hard goals come more often. Evaluation draws as the task does."""
    goal_choice: str = 'uniform'
    """Which of 8 future goals is taken: `uniform` (any), `bellman` (the value that errs most) or
    `uncertain` (that critics differ in most)."""
    importance: str = 'none'
    """Weights of transitions: `none`; `density` (in the critic's loss) takes back that a goal in
    hindsight depends on where the transition led; `decision` (of `ppo`) that the actions of a
    replayed episode are those for another goal."""
    moved_share: float = 0.0
    """Share of a batch drawn by `episode_weights`; 0 draws uniformly."""
    episode_weights: str = 'moved'
    """Weights of episodes: `moved` (1 where the achieved goal moved, else 0) or `energy` (given to
    the object). Where a `gamble` landed counts for neither."""
    ticks_after_drop: int = -1
    """Ticks after an object fell off the palm that are still learnt from; -1 is all."""
    drop_is_lost: bool = False
    """With `ticks_after_drop`, what follows the last of them counts -1 for ever. Without it nothing
    teaches that a drop is final."""

    condition: str = 'none'
    """One input more of actor and critic: `none`, `threshold` (log-uniform, .5 ...
    `widest_threshold` times that of success, also in the reward) or `horizon` (steps left, of which
    values count the rewards). The actor acts at the threshold of the task and with a whole episode
    left."""
    widest_threshold: float = 8.0
    """Largest threshold of `condition=threshold`, in those of success. It should reach from where
    episodes begin to their goals."""
    n_step: int = 1
    """Most steps of a return before it bootstraps."""
    correction: str = 'none'
    """For longer returns, whose actions are not the actor's: `none`, `lambda` (their mean is the
    truncated lambda-return) or `cut` (they end before an action far from the actor's)."""
    trace: float = 0.7
    """With `lambda`, the probability of going on after each step; of `ppo` the same lambda."""
    cut_distance: float = 0.3
    """With `cut`, the farthest action from the actor's, root mean square."""

    init_from: str = ''
    """Networks and normalisers to start from: a run folder, a shipped actor or the file of one;
    their mean where several are given with commas; empty starts from nothing."""
    first_value: float = 0.0
    """What the critic of `ppo` says before it has learnt: with -1 / (1 - gamma), what failing for
    ever is worth, nothing looks good because it is new."""
    first_action_gain: float = 1.0
    """Factor on the last layer of the actor of `ppo` before it has learnt: near 0 it begins with
    noise around no action, whatever the seed."""
    critic_first: int = 0
    """Updates of the critics alone before the actor learns too; 0 is 5,000 where `init_from` is an
    actor without its critic, or with fewer than `critics`, else none."""
    total_steps: int = 5_000_000
    """Environment steps of the run."""
    time_limit: float = 0.0
    """Seconds after which the run ends; 0 is no limit."""
    success_target: float = 0.0
    """The run ends when an evaluation reaches this success; 0 is never."""

    num_envs: int = 64
    """Simulations stepped together; each cycle collects one episode of each."""
    updates_per_cycle: int = 40
    """Gradient updates after each cycle."""
    batch_size: int = 1024
    """Transitions per update."""
    replay_transitions: int = 1_000_000
    """Capacity of the replay."""
    random_steps: int = 0
    """Steps with uniformly random actions before the policy acts."""
    learning_starts: int = 0
    """Steps in the replay before the first update."""
    kept_transitions: int = 300_000
    """Newest transitions kept beside the training state for `--resume`."""
    future_only_steps: int = 0
    """Steps during which futureactual is replaced by future."""

    goal_features: str = 'plain'
    """Inputs of actor and critic: `plain` (observation and goal), `relative` (how far
    the goal is as well) or `symmetric` (alike poses are one, of the goal only the distance)."""
    hidden_sizes: tuple[int, ...] = (256, 256, 256)
    """Width of each hidden layer of actor and critic."""
    layer_norm: bool = False
    """LayerNorm in hidden layers of actor and critic."""
    learning_rate: float = 1e-3
    """Adam step size of actor and critic."""
    final_learning_rate: float = 1.0
    """Share of `learning_rate` left to actor and critic at `total_steps`, falling linearly; 1 keeps
    it constant. What imagines subgoals keeps the whole."""
    actor_average: float = 0.0
    """Share of an average of actor weights kept each cycle; the average is what is evaluated and
    saved, as best and as latest. 0 evaluates the actor itself."""
    gamma: float = 0.98
    """Discount; targets are clipped to [-1/(1-gamma), 0], as in the paper's code also those of
    dense rewards, which lie below -1 where a pose is far from its goal."""
    discount: str = 'tick'
    """What `gamma` discounts: one `tick`, or `time`: 40 ms, whatever a tick is. A tick's reward is
    then that for its share of 40 ms, so that values are as large at every rate."""
    advantage: bool = False
    """Critics learn values of states and advantages per 40 ms (DAU) instead of action values."""
    action_l2: float = 1.0
    """Weight of the mean squared action in the actor loss."""
    temporal_smoothness: float = 0.0
    """Weight in the actor loss of the mean squared change of its action from one tick to the next
    (CAPS, arXiv 2012.06644)."""
    polyak: float = 0.95
    """Share of the old target network kept by a target update."""
    target_update_interval: int = 40
    """Updates between target updates."""
    policy_delay: int = 1
    """Updates of the critic for each of the actor (TD3, arXiv 1802.09477): 2 takes three quarters
    of the time."""
    target_noise: float = 0.0
    """Standard deviation of noise, cut at 2.5 times it, on the actions that targets value (TD3):
    actions close to each other are worth the same."""
    target: str = 'polyak'
    """Networks that targets are computed with: `polyak` (slow copies) or `none` (those that
    learn)."""
    norm: str = 'none'
    """What normalises hidden layers of the critic alone: `none`, `layer` or `batch` (as CrossQ,
    without target networks); `layer_norm` is for both networks."""
    critics: int = 1
    """Critics that start differently; the actor follows their mean."""
    aggregate: str = 'mean'
    """What targets take of several critics: `mean`, `min` or `truncated` (the mean without the
    highest)."""
    quantiles: int = 1
    """Quantiles of the return that each critic learns; 1 is its mean alone. Targets then take all
    of them (`mean`), or leave out the highest 2 in 25 (`truncated`: TQC, arXiv 2005.04269)."""

    random_epsilon: float = 0.3
    """Probability of a uniformly random action."""
    noise_std: float = 0.2
    """Standard deviation of the Gaussian noise on other actions."""
    noise_spread: float = 0.0
    """Exploration differs between simulations: from 1 - spread to 1 + spread times both."""
    noise_seconds: float = 0.0
    """How long noise and random actions hold once they are drawn; 0 is one tick."""
    parameter_noise: bool = False
    """Instead of Gaussian noise on actions, noise on weights that moves actions by `noise_std`."""
    longest_hold: int = 1
    """Most ticks for which the actor lets an action hold while it collects; above 1 it learns how
    long. The actor that is evaluated and saved decides at every tick."""
    subgoal_every: int = 0
    """Ticks for which a subgoal holds that a second, high level proposes to the actor while it
    collects; 0 has none. The actor that is evaluated and saved is given the goal itself."""
    subgoal_prior: float = 0.0
    """Weight of the distance between the actor's actions and those for an imagined subgoal, halfway
    to the goal by value, in the actor loss; 0 imagines none."""
    imagination_interval: int = 1
    """Updates of the actor for each of the network that imagines subgoals, which costs almost as
    much as one of actor and critic."""
    final_exploration: float = 1.0
    """Share of `random_epsilon` and `noise_std` left at `total_steps`; both fall linearly in
    the last third of the run. 1 keeps them constant."""

    evaluate_every: int = 50_000
    """Environment steps between evaluations; the actor that a run ends with is evaluated too."""
    evaluation_episodes: int = 200
    """Episodes behind a decision which actor is best; hopeless evaluations end earlier."""
    checkpoint_seconds: float = 180.0
    """Seconds between checkpoints."""

    overlap: bool = True
    """Collect with the actor of one cycle ago while learning; False alternates strictly."""
    simulation_threads: int = 0
    """Threads that step simulations; 0 is the cores that tensors leave."""
    torch_threads: int = 0
    """Threads of one tensor operation; 0 is 1 up to batches of 1024, then half of the cores."""
    precision: str = 'auto'
    """`float32`, `bfloat16` (autocast), or `auto`: bfloat16 where the processor has it. `ppo` knows
    float32 alone."""
    device: str = 'auto'
    """`auto`, `cpu` or `cuda`."""

    @property
    def narrows(self) -> bool:
        """Whether goals are met more easily at the start of a run than at its end."""
        return self.first_distance != 1.0 or self.first_rotation != 1.0

    @property
    def tick_share(self) -> float:
        """Duration of a tick in units of what `gamma` discounts."""
        return DEFAULT_CONTROL_HZ / self.control_hz if self.discount == 'time' else 1.0

    @property
    def tick_gamma(self) -> float:
        """Discount of a tick."""
        return float(self.gamma**self.tick_share)

    @property
    def lowest_value(self) -> float:
        """Value of a state from which every tick is rewarded with -1 for ever."""
        return -self.tick_share / (1.0 - self.tick_gamma)

    @property
    def noise_ticks(self) -> int:
        """For how many ticks noise holds."""
        return max(round(self.noise_seconds * self.control_hz), 1)
