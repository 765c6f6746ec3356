"""The vector environment: N environments of one class over one pool."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import CloudpickleWrapper, batch_space

from fmugym.checks import check_count, refuse_positional
from fmugym.environment.construction import prepare_hooks, require_construction
from fmugym.environment.env import FMUEnv
from fmugym.environment.episode_limit import EpisodeLimit
from fmugym.environment.pool_opening import open_env_pool
from fmugym.environment.saved_episode import require_saving
from fmugym.environment.snapshots import Snapshot, checked_snapshot
from fmugym.environment.vector.arguments import (
    autoreset_mode_of,
    checked_num_envs,
    checked_pool_options,
    checked_seeds,
    split_options,
)
from fmugym.environment.vector.async_step import Background, PendingStepError
from fmugym.environment.vector.attributes import Attributes
from fmugym.environment.vector.env_maker import EnvMaker
from fmugym.environment.vector.episodes import Episodes
from fmugym.environment.vector.rollouts import (
    Candidates,
    Rollout,
    keys_of,
    offsets_of,
    returning_to,
    roll_out,
    start_of_rollout,
    tables_of,
    tunable_values,
)
from fmugym.environment.vector.saved_batch import chosen, sources_for
from fmugym.environment.vector.task_choice import make_task, require_own_order
from fmugym.environment.vector.tasks import StepResult, VectorTask
from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.pool import Pool
from fmugym.pool.pool import MaskArray

__all__ = ["FMUVectorEnv", "require_open"]


class FMUVectorEnv(VectorEnv[Any, Any, Any]):
    """N environments of one class, whose FMU instances step in one call.

    They are for one thread, as a single environment is; see ``FMUEnv``.

    Seeded with ``s``, environment i reproduces a single environment seeded with ``s + i``, step by
    step and episode after episode.

    A copy, or what is loaded from a pickle, is a new vector environment of the same arguments. A
    deep copy goes on with the same episodes.

    Args:
        make_env: A function without arguments, or a class, that returns a new environment in each
            call; wrappers are refused. It is called once, or once for each environment if hooks are
            called one by one. Pickles carry it with them.
        num_envs: N.
        max_episode_steps: Truncates episodes; ``gymnasium.make_vec`` passes the spec's.
        autoreset_mode: What follows the end of an episode: ``NEXT_STEP`` (the next step starts an
            episode instead), ``SAME_STEP`` (the same step does; the last observations and infos are
            ``infos["final_obs"]``, in the form of observations, and ``infos["final_info"]``, where
            ``infos["_final_obs"]`` is true) or ``DISABLED`` (``reset`` with
            ``options["reset_mask"]`` must follow).
        pool_options: Of ``fmugym.pool.opening.PoolOptions``: ``backend``, ``threads``,
            ``private_libraries``, ``isolation``, ``workers``, ``call_timeout``.

    Attributes:
        autoreset_mode: What follows the end of an episode; ``metadata`` has it, too.
        prototype: The first of the environments, whose task all have.
        pool: Has the FMUs.
        task: Surrounds the step of the FMUs by expressions or hooks.
        episodes: Have the quantities that these read.
        attributes: Reads, sets and calls what single environments have.
        maker: Makes environments of the same class.

    Raises:
        ConfigError: If an argument does not fit, or the class overrides ``step`` or ``reset``. For
            an unknown argument it is a ``TypeError``, too.
        FMULoadError: If the FMU cannot be used on this machine.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012  (as in FMUEnv)

    _arguments: tuple[tuple[Any, ...], dict[str, Any]]

    prototype: FMUEnv
    pool: Pool
    task: VectorTask
    episodes: Episodes
    attributes: Attributes
    maker: EnvMaker

    _limit: EpisodeLimit
    _at_ends: tuple[Callable[[Any], None], ...] = ()

    def __new__(cls, *args: Any, **kwargs: Any) -> FMUVectorEnv:
        """Keep the arguments for copies."""
        env = super().__new__(cls)
        env._arguments = args, kwargs
        return env

    def __init__(
        self,
        make_env: Callable[[], Any],
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **pool_options: Any,
    ) -> None:
        if not callable(make_env):
            raise ConfigError(
                f"make_env must be a class or a function without arguments, got {shown(make_env)}"
            )
        self.num_envs = checked_num_envs(num_envs)
        self.autoreset_mode = autoreset_mode_of(autoreset_mode)
        limit = max_episode_steps
        limit = None if limit is None else check_count("max_episode_steps", limit)
        options = checked_pool_options(pool_options, self.num_envs)
        try:
            self.maker = EnvMaker(make_env)
            self.prototype = self.maker.make()
            require_construction(self.prototype)
            self._set_up_or_close(limit, options)
        except MemoryError:
            raise ConfigError(f"there is not enough memory for num_envs = {num_envs}") from None

    def _set_up_or_close(
        self, max_episode_steps: int | None, pool_options: Mapping[str, Any]
    ) -> None:
        env = self.prototype
        try:
            require_own_order(env)
            self.pool = open_env_pool(
                env, self.num_envs, max_episode_steps=max_episode_steps, **pool_options
            )
            try:
                env._use(self.pool)
                self._set_up(max_episode_steps)
            except BaseException:
                self.pool.close()
                raise
        except BaseException:
            env.close()
            raise

    def _set_up(self, max_episode_steps: int | None) -> None:
        env, count = self.prototype, self.num_envs
        self._limit = EpisodeLimit.of(env).shortened(max_episode_steps)
        prepare_hooks(env)  # its constructor may have changed the spaces
        self.metadata = {**env.metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = env.render_mode
        self.single_action_space = env.action_space
        self.single_observation_space = env.observation_space
        self.action_space = batch_space(env.action_space, count)
        self.observation_space = batch_space(env.observation_space, count)
        self._waits = self.autoreset_mode is AutoresetMode.DISABLED  # for a reset after an end
        self._restarts = self.autoreset_mode is AutoresetMode.SAME_STEP
        self._background = Background()
        self.task = make_task(self.maker, env, self.pool, max_episode_steps)
        self.episodes, self.attributes = self.task.episodes, Attributes(self.task)

    # Episodes and steps.

    def reset(
        self,
        *misplaced: object,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start new episodes.

        Args:
            misplaced: None: the others are given by name.
            seed: Environment i is seeded with ``seed + i``, or with ``seed[i]`` of a list.
            options: As for a single environment, and ``"reset_mask"``, a Boolean array of shape
                (N,): which environments to reset. The others go on.

        Returns:
            The observations of all environments, and the infos.

        Raises:
            ConfigError: If seeds or options do not fit.
            SimulationError: If an FMU cannot be initialized, or the vector environment is closed.
        """
        if misplaced:
            refuse_positional(misplaced)
        if not self.episodes.is_ready or self._background.is_pending:
            require_open(self, "reset")
        elif (
            seed is None and type(options) is dict and len(options) == 1 and "reset_mask" in options
        ):
            try:
                result = self.task.start_at_once(options["reset_mask"])
            except BaseException:
                self._interrupt()
                raise
            if result is not None:
                return result
        remaining, mask = split_options(options, self.num_envs)
        if not self.episodes.is_ready and not mask.all():
            when = "reset after an exception" if self.episodes.started else "first reset"
            raise ConfigError(f"the {when} must be of all environments")
        seeds = None if seed is None else checked_seeds(seed, self.num_envs)
        try:
            observations, infos = self.task.reset(mask, seeds, remaining)
        except BaseException:
            self._interrupt()
            raise
        self.episodes.let_step()
        return observations, infos

    def step(self, actions: Any) -> StepResult:
        """Step all environments.

        Args:
            actions: A batch of actions, environments first. All are checked, also those of
                environments that this step resets, unless the class has its own ``step``.

        Returns:
            Observations, rewards (float64), terminated, truncated, infos. The arrays belong to the
            caller; the memory of arrays that nobody holds any more may be used again. A reward that
            is not finite is a fault, as an FMU that fails.

        Raises:
            ConfigError: If the actions do not fit, or a hook returns what cannot be used.
            SimulationError: Before the first reset, after ``close``, in mode ``DISABLED`` after an
                end, and, with ``on_fault="raise"``, after a fault. Also after an exception that
                came when the FMUs had stepped, until all environments are reset.
            PendingStepError: Between ``step_async`` and ``step_wait``; a ``SimulationError``, too.
        """
        self._require_ready("step")
        return self._step(actions)

    def step_around(self, actions: Any, resting: MaskArray) -> StepResult:
        """Step some environments, while the others stay as they are.

        Args:
            actions: As for ``step``, of all environments.
            resting: Which ones stay as they are, shape (N,). Their rewards are 0, neither
                terminated nor truncated is true for them, and their episodes count as ended.

        Returns:
            As ``step``.

        Raises:
            ConfigError: As ``step``.
            SimulationError: As ``step``, but for ended episodes, which may rest.
            PendingStepError: As ``step``.
        """
        self._require_ready("step_around", ended=True)
        try:
            return self.task.step_around(actions, resting)
        except BaseException:  # as in a single environment
            self._interrupt()
            raise

    def step_async(self, actions: Any) -> None:
        """Begin a step of all environments, which goes on while the caller computes.

        The FMUs step in a thread of their own, without the interpreter's lock. Hooks in Python run
        in this thread, too. Until ``step_wait``, only ``close`` may be called.

        Args:
            actions: As for ``step``; a copy is made.

        Raises:
            SimulationError: As ``step``, if it cannot begin. All other errors are raised by
                ``step_wait``.
            PendingStepError: If a step is under way; a ``SimulationError``, too.
        """
        self._require_ready("step_async")
        copied = actions.copy() if type(actions) is np.ndarray else copy.deepcopy(actions)
        self._background.begin(self._step, copied)

    def step_wait(self, timeout: float | None = None) -> StepResult:
        """Wait for the step that ``step_async`` has begun.

        Ctrl-C interrupts the waiting, not the step: ``step_wait`` may be called again.

        Args:
            timeout: The longest time to wait, in seconds; None for no limit.

        Returns:
            As ``step``.

        Raises:
            ConfigError: As ``step``.
            SimulationError: As ``step``.
            NoStepError: If no step is under way; a ``SimulationError``, too.
            StepTimeoutError: If the step does not end in time; a ``SimulationError``, too. The step
                goes on, and ``step_wait`` may be called again.
        """
        if self.closed:
            raise SimulationError(f"step_wait was called on a closed {type(self).__name__}")
        result: StepResult = self._background.finish(timeout)
        return result

    def _require_ready(self, method: str, *, ended: bool = False) -> None:
        """Refuse a call before the first reset and so on; ``ended`` episodes may be allowed."""
        episodes = self.episodes
        if not episodes.is_ready or self._background.is_pending:
            require_open(self, method)
            when = "before the first reset"
            if episodes.started:
                when = "after an exception that has ended all episodes; call reset first"
            raise SimulationError(f"{method} was called {when}")
        if episodes.any_ended and self._waits and not ended:
            index = int(np.flatnonzero(episodes.ended)[0])
            raise SimulationError(f"the episode of environment {index} has ended: reset it first")

    def _step(self, actions: Any) -> StepResult:
        """Step all environments, in this thread or in the background."""
        task, restarts = self.task, self._restarts
        try:
            result = task.step(actions, restarts and not self._at_ends)
            if restarts and self.episodes.any_ended:
                for look in self._at_ends:
                    look(actions)
                result = task.restarted(result)
            return result
        except BaseException:  # as in a single environment
            self._interrupt()
            raise

    def _interrupt(self) -> None:
        """After an exception, end the episodes whose FMUs have stepped without a result."""
        self.pool.halt()
        if self.task.has_moved:
            self.episodes.is_ready = False

    def look_at_ends(self, look: Callable[[Any], None]) -> None:
        """Call a function of the actions where episodes have ended and the next have not begun.

        That moment is within a step in the mode ``SAME_STEP``.
        """
        self._at_ends = (*self._at_ends, look)

    def render(self) -> tuple[Any, ...] | None:
        """Draw all environments.

        Returns:
            Their pictures, or None without a render mode.

        Raises:
            SimulationError: Before the first reset, and after ``close``.
        """
        require_open(self, "render")
        if self.render_mode is None:
            return None
        return tuple(self.attributes.render(range(self.num_envs)))

    # Snapshots.

    def save_state(self, where: Any = None) -> Snapshot:
        """Save the episodes of environments at this moment; see ``FMUEnv.save_state``.

        Args:
            where: Which environments: a Boolean mask of shape (N,), an index, or a list of indices;
                None for all.

        Raises:
            ConfigError: If ``where`` does not fit, or hooks have assigned to attributes.
            SimulationError: Before the first reset, after ``close``, if real systems stand in for
                the FMUs, or if an FMU fails.
        """
        self._require_ready("save_state", ended=True)
        return self.episodes.save(chosen(where, self.num_envs))

    def restore_state(self, snapshot: Snapshot, where: Any = None) -> Any:
        """Let environments go on from a snapshot, with their random streams.

        Args:
            snapshot: Of single or vector environments with the same FMU and config. If it is of one
                environment, all in ``where`` go on from it, with the same random streams.
                Otherwise it has one episode for each in ``where``.
            where: As for ``save_state``.

        Returns:
            The observations of all environments.

        Raises:
            ConfigError: If the snapshot or ``where`` does not fit, or if it is not of all
                environments before the first reset.
            SimulationError: If an FMU fails, or if real systems stand in for the FMUs.
        """
        require_open(self, "restore_state")
        indices = chosen(where, self.num_envs)
        sources = sources_for(checked_snapshot(snapshot), indices)
        columns = self.episodes.columns_of(snapshot)
        if not self.episodes.is_ready and len(indices) < self.num_envs:
            raise ConfigError("before a reset of all, a snapshot must be restored in all")
        self.episodes.require_fit(columns)
        require_saving(self.pool)
        self.episodes.is_ready = False
        self.episodes.restore(snapshot.bundle, sources, indices)
        self.episodes.place(columns, sources, indices)
        self.episodes.let_step()
        return self.task.observe(indices)

    def rollout(
        self,
        snapshot: Snapshot | None,
        actions: Any,
        *,
        horizon: int | None = None,
        parameters: Mapping[str, Any] | None = None,
        data: Mapping[str, Any] | None = None,
        offsets: Mapping[str, float] | None = None,
        seed: int | None = None,
    ) -> Rollout:
        """Try out candidates for the next actions.

        The environments return to their present episodes afterwards, if they have any. Hooks are
        included.

        Args:
            snapshot: Where the candidates begin: a snapshot of one environment, or of one for each
                candidate. None stands for the present episodes of all environments.
            actions: The actions of n candidates, shape (n, horizon, ...). n may be larger than the
                number of environments, unless ``snapshot`` is None. Or a policy: a function that
                returns the actions of N environments, as for ``step``, from their observations;
                there are N candidates then.
            horizon: The number of steps of a policy.
            parameters: Tunable parameters of the FMU that candidates have from here on: an array of
                shape (n,), or one number for all, by name. For other parameters, let each candidate
                begin with an episode that has been reset with its own.
            data: What candidates read in the place of the task's data: by name the times in
                seconds, on the clock of the data, and the values. They are read as those of the
                file are, and repeat after the same period. By default candidates know what will
                come.
            offsets: What is added to outputs and monitored variables of the FMU for all that
                hooks read, in the FMU's units, by name. The FMU itself does not notice.
            seed: The noise and the random set points of all candidates are those of an episode
                with this seed. By default they go on with those of the snapshot.

        Raises:
            ConfigError: If the snapshot, the actions or what candidates assume do not fit.
            SimulationError: If an episode of the snapshot has ended, an FMU cannot be restored, or,
                with ``on_fault="raise"``, a step fails.
        """
        require_open(self, "rollout")
        candidates = Candidates.of(self.single_action_space, self.num_envs, actions, horizon)
        prototype, count = self.prototype, candidates.count
        candidates.parameters = tunable_values(prototype, parameters, count)
        candidates.tables = tables_of(prototype, data)
        candidates.offsets = offsets_of(prototype, offsets)
        candidates.variables = keys_of(prototype, seed)
        present = self.save_state() if self.episodes.is_ready else None
        start = start_of_rollout(self.episodes, snapshot, present, count)
        with returning_to(self.episodes, present):
            return roll_out(self.task, start, candidates)

    # Single environments.

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Read an attribute, an episode variable or a parameter of the FMU, of each environment.

        Raises:
            ConfigError: If there is nothing of this name (it is an ``AttributeError``, too).
            SimulationError: After ``close``.
        """
        require_open(self, "get_attr")
        return tuple(self.attributes.read(name, range(self.num_envs)))

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute, an episode variable or a parameter of the FMU, of each environment.

        Args:
            name: An attribute that hooks read, or the name of a variable or a parameter. A variable
                has the value now and at the start of episodes; a parameter takes effect with the
                next episode. Where only expressions run, there are no attributes to set.
            values: A list or array of one value for each environment, or one value for all. Unless
                hooks are called one environment at a time, values that differ must be numbers.

        Raises:
            ConfigError: If there is nothing of this name, every environment keeps it itself, the
                number of values is wrong, or they do not fit.
            SimulationError: After ``close``.
        """
        require_open(self, "set_attr")
        self.attributes.set(name, values)

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's spec, whose ``max_episode_steps`` truncates episodes."""
        return vars(self).get("spec")

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        vars(self)["spec"] = self._limit.told_by(value)

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]  # one each
        """The seeds of the environments' generators, as in Gymnasium's ``SyncVectorEnv``."""
        return tuple(self.episodes.seed_of(index) for index in range(self.num_envs))

    @property
    def health(self) -> dict[str, npt.NDArray[np.int64]]:
        """The counters of each environment's FMU, arrays of shape (N,); see ``FMUEnv``.

        Raises:
            SimulationError: After ``close``.
        """
        require_open(self, "health")
        return self.pool.health()

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method of each environment, or read an attribute.

        Numbers that the method assigns to attributes and to episode variables take effect.

        Raises:
            ConfigError: If there is nothing of this name, the method cannot be called for single
                environments, or it changes what they cannot have each for itself.
            SimulationError: After ``close``.
        """
        require_open(self, "call")
        return tuple(self.attributes.call(name, range(self.num_envs), args, kwargs))

    def close_extras(self, **kwargs: Any) -> None:
        """Free the pool, after waiting for a step that is under way."""
        if "task" in vars(self):  # otherwise the constructor has closed everything
            self._background.stop()
            self.episodes.forbid_steps()
            try:
                self.episodes.close()
            finally:
                self.pool.close()

    # Copies.

    def __copy__(self) -> FMUVectorEnv:
        return _rebuilt(type(self), self._arguments, self.spec)

    def __deepcopy__(self, memo: dict[int, Any]) -> FMUVectorEnv:
        arguments = copy.deepcopy(self._arguments, memo)
        twin = _rebuilt(type(self), arguments, copy.deepcopy(self.spec, memo))
        if self.episodes.is_ready:
            twin.restore_state(self.save_state())
        return twin

    def __reduce__(self) -> tuple[Callable[..., FMUVectorEnv], tuple[bytes]]:
        construction: Any = type(self), self._arguments, self.spec
        try:
            return _unpickled, (pickle.dumps(CloudpickleWrapper(construction)),)
        except Exception as error:  # the arguments are the user's
            raise ConfigError(
                f"this {type(self).__name__} cannot be pickled: {error}. Give it a make_env that "
                "can: a class, a function of a module, or a functools.partial of one of them"
            ) from None

    def __repr__(self) -> str:
        return f"<FMUVectorEnv of {self.num_envs}: {self.prototype!r}>"


def require_open(envs: FMUVectorEnv, method: str) -> None:
    """Refuse a closed vector environment, and one in which a step is under way.

    Raises:
        SimulationError: If it is closed.
        PendingStepError: If a step is under way; a ``SimulationError``, too.
    """
    if envs.closed:
        raise SimulationError(f"{method} was called on a closed {type(envs).__name__}")
    if envs._background.is_pending:
        raise PendingStepError(
            f"{method} was called while a step is under way; call step_wait first"
        )


def _rebuilt(
    cls: type[FMUVectorEnv], arguments: tuple[tuple[Any, ...], dict[str, Any]], spec: Any
) -> FMUVectorEnv:
    args, kwargs = arguments
    env = cls(*args, **kwargs)
    env.spec = spec
    return env


def _unpickled(construction: bytes) -> FMUVectorEnv:
    return _rebuilt(*pickle.loads(construction).fn)
