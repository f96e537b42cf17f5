"""Plays an episode with a learned policy and renders it."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from rewire_jax.core.arguments import check_seconds, check_whole, require
from rewire_jax.core.errors import UserError, writing
from rewire_jax.envs.base import Environment, HostEnvironment, Task
from rewire_jax.envs.geom_trajectory import Film
from rewire_jax.envs.scenarios import Scenario, make_scenario
from rewire_jax.run import run_checkpoints, sweep_members
from rewire_jax.run.policies import PolicyFunction, load_policy
from rewire_jax.run.run_checkpoints import saved
from rewire_jax.run.task_header import check_tasks
from rewire_jax.storage import checkpoint, run_folder


class Rendered(NamedTuple):
    """An episode that was rendered.

    Attributes:
      title: scenario and task.
      caption: the policy, and the episode's return and length.
      returns: undiscounted return of the episode.
      steps: length of the episode.
      page: the web page.
      gif: the animation; None if there is none.
      note: why there is no GIF, if one was requested.
    """

    title: str
    caption: str
    returns: float
    steps: int
    page: Path
    gif: Path | None = None
    note: str = ""


class _Played(NamedTuple):
    """An episode: a first frame, then a frame, reward and success for each step."""

    film: Film
    rewards: list[float]
    success: list[bool]


def render(
    run: str | Path,
    *,
    task: int,
    seed: int | None = None,
    stage: int | None = None,
    member: int | None = None,
    episode: int = 0,
    out: str | Path = "episode.html",
    seconds: float = 10.0,
) -> Rendered:
    """Plays one episode without exploration and writes a web page that shows it.

    The page needs no network and no other file. If MuJoCo can draw without a window,
    this also writes a GIF of the beginning of the episode.

    Args:
      run: folder of the run, or of a sweep.
      task: index of the task, from 0.
      seed: seed of the member whose policy acts; the first seed if None.
      stage: use the policy from after this task; if None, after the latest task.
      member: only for a sweep, instead of the seed: a number in members.csv.
      episode: a number that determines the initial state.
      out: the page; its name ends in `.html`. The GIF has the same name.
      seconds: length of the GIF; 0 for no GIF.

    Returns:
      The files, and the result of the episode.

    Raises:
      UserError: no such run, task, seed, member or stage; the policy has not learned
        the task and `stage` is None; or the environment cannot be rendered.
    """
    page = Path(out)
    require(page.suffix == ".html", f"--out {page}: a web page's name ends in .html")
    check_seconds("--seconds", seconds)
    check_whole("--episode", episode)
    act = load_policy(run, task=task, seed=seed, stage=stage, member=member)
    folder = Path(run)
    header, settings = saved(folder, run_folder.kind(folder))
    learned = _learned(folder, member) if stage is None else stage + 1
    require(
        task < learned or stage is not None,
        f"{folder}: task {task} has not been trained yet; to render the policy anyway, "
        f"add --stage {learned - 1}",
    )
    scenario = make_scenario(settings.scenario, settings.backend, settings.reward)
    check_tasks(folder, header, scenario, settings.tasks)
    played = _play(scenario, scenario.tasks[task].data, act, episode)
    if member is None:
        who = f"seed {settings.seed if seed is None else seed}"
    else:
        who = f"member {member}"
    returns, steps = sum(played.rewards), len(played.rewards)
    title = f"{scenario.name}, task {task}: {scenario.tasks[task].name}"
    caption = (
        f"{settings.method}, {who}, after {learned} of {settings.tasks} tasks; episode "
        f"{episode}: return {returns:.1f} in {steps} steps"
        f"{', solved' if any(played.success) else ''}"
    )
    # These imports are slow and needed only here.
    from rewire_jax.rendering import webpage
    from rewire_jax.rendering.gif import write_gif

    run_folder.make(page.parent)
    gif = page.with_suffix(".gif")
    with writing(page):
        page.write_text(webpage.to_html(played.film, title, caption), encoding="utf-8")
        gif.unlink(missing_ok=True)  # of another episode
    rendered = Rendered(title, caption, returns, steps, page)
    if not seconds:
        return rendered
    try:
        write_gif(played.film, gif, seconds=seconds)
    except UserError as error:
        return rendered._replace(note=f"no GIF: {error}")
    return rendered._replace(gif=gif)


def _learned(folder: Path, member: int | None) -> int:
    """Number of tasks that the latest policy has learned."""
    if member is not None:
        folder = sweep_members.find(folder, member, None).folder
    return checkpoint.read_metadata(run_checkpoints.kept(folder, None))["stage"]


def _play(scenario: Scenario, task: Task, act: PolicyFunction, episode: int) -> _Played:
    """Plays one episode; `UserError` if the environment cannot be rendered."""
    environment = scenario.environment
    if isinstance(environment, HostEnvironment):
        played = _hosted(environment, task, jax.jit(act), episode)
    else:
        played = _simulated(environment, task, jax.jit(act), episode)
    if played is None:
        raise UserError(
            f"cannot render {scenario.name} on {scenario.backend}: choose halfcheetah, "
            "ant or humanoid, or Meta-World on mujoco"
        )
    return played


def _simulated(
    environment: Environment, task: Task, act: Callable[..., jax.Array], episode: int
) -> _Played | None:
    if environment.film is None:
        return None
    state = environment.reset(task, jax.random.key(episode))
    states = [state]
    while len(states) <= environment.episode_length and not state.terminal:
        state = environment.step(task, state, act(state.observation))
        states.append(state)
    return _Played(
        environment.film(task, [state.inner for state in states]),
        [float(state.reward) for state in states[1:]],
        [bool(state.success) for state in states[1:]] if environment.success else [],
    )


def _hosted(
    environment: HostEnvironment,
    task: Task,
    act: Callable[..., jax.Array],
    episode: int,
) -> _Played | None:
    env = environment.make()
    observation, _ = env.reset(seed=episode, options={"task": int(task.physics)})
    seen = getattr(env, "simulation", None)
    if seen is None:
        return None
    frames = [(seen.data.geom_xpos.copy(), seen.data.geom_xmat.copy())]
    rewards: list[float] = []
    success: list[bool] = []
    ended = False
    while len(rewards) < environment.episode_length and not ended:
        action = act(observation * np.asarray(task.observation_mask))
        observation, reward, ended, _, info = env.step(
            np.asarray(action * task.action_scale)
        )
        frames.append((seen.data.geom_xpos.copy(), seen.data.geom_xmat.copy()))
        rewards.append(float(reward))
        success.append(bool(info.get("success", False)))
    position, rotation = map(np.array, zip(*frames, strict=True))
    film = Film(seen.model, seen.dt, position, rotation.reshape(*position.shape, 3))
    return _Played(film, rewards, success)
