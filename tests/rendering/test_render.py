import dataclasses
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

import rewire_jax
from rewire_jax.cli import main
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings_json import to_json
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.rendering import render
from rewire_jax.run import run_checkpoints, run_state
from rewire_jax.run.task_header import header_of_tasks
from rewire_jax.storage import run_folder
from rewire_jax.storage.sweep_results import batch, batches_of
from rewire_jax.training.run_setup import prepare
from tests.command_line import fails
from tests.rendering.test_webpage import embedded, scene
from tests.tiny import tiny

STEPS = 12
# A backend with links, from which geometries can be found.
CHEETAH = "halfcheetah/forgetting", "positional"
FEET = {"geom5", "geom8"}  # halfcheetah's
SWEEP = {
    "kind": "sweep",
    "members": [
        {"member": n, "configuration": 0, "seed": 5 + n, "values": {}} for n in (0, 1)
    ],
}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def untrained(folder: Path, scenario: str, *, stage: int = 2, **more) -> Path:
    """A run that claims to have learned tasks; its policies are the first ones.

    What is in `more` is added to its header.
    """
    settings = dataclasses.replace(tiny(scenario, "ft1"), tasks=3, envs=1, seed=5)
    if scenario == CHEETAH[0]:
        settings = dataclasses.replace(settings, backend=CHEETAH[1])
    plan = prepare(settings)
    header = {
        "settings": to_json(plan.settings),
        **header_of_tasks(plan.scenario, settings.tasks) | {"episode_length": STEPS},
        "spec": plan.spec._asdict(),
        **more,
    }
    with run_folder.held(folder, header):
        at = batch(folder, stage - 1, 0) if "members" in more else folder
        run_checkpoints.save(at, run_state.start(plan)._replace(stage=stage), plan)
    return folder


@pytest.fixture
def short(monkeypatch) -> None:
    """Episodes of a few steps."""

    def make(*words):
        scenario = make_scenario(*words)
        environment = scenario.environment._replace(episode_length=STEPS)
        return dataclasses.replace(scenario, environment=environment)

    monkeypatch.setattr(render, "make_scenario", make)


@pytest.fixture(scope="module")
def cheetah(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("rendering") / "run"
    return untrained(folder, CHEETAH[0])


def walked(run: Path, task: int, episode: int):
    """The same episode: positions of the links, frame by frame, and the return."""
    scenario = make_scenario(*CHEETAH)
    data = scenario.tasks[task].data
    act = rewire_jax.load_policy(run, task=task)
    states = [scenario.environment.reset(data, jax.random.key(episode))]
    for _ in range(STEPS):
        action = act(states[-1].observation)
        states.append(scenario.environment.step(data, states[-1], action))
    position = np.array([state.inner.x.pos for state in states])
    return position, float(sum(state.reward for state in states))


def test_a_page_shows_the_episode_that_is_played(
    cheetah: Path, short, tmp_path: Path
) -> None:
    run, out = cheetah, tmp_path / "new" / "walk.html"
    made = rewire_jax.render(run, task=1, episode=3, out=out, seconds=0)
    page = out.read_text()
    found = embedded(page)
    position, returns = walked(run, 1, 3)
    assert made.steps == STEPS
    assert len(found["position"]) == STEPS + 1
    assert made.returns == pytest.approx(returns, rel=1e-4)
    # Links are where their geometries are less these's own offsets, turned along.
    system = make_scenario(*CHEETAH).tasks[1].data.physics
    for frame in (0, STEPS):
        for place, name in enumerate(found["names"]):
            geom = int(name.removeprefix("geom"))
            link = position[frame, system.geom_bodyid[geom] - 1]
            offset = np.array(found["position"][frame][place]) - link
            own = np.linalg.norm(system.geom_pos[geom])
            assert np.linalg.norm(offset) == pytest.approx(own, abs=2e-3)
    assert found["seconds"] == pytest.approx(0.05)
    for said in ("halfcheetah/forgetting", "task 1: moon", "ft1, seed 5, after 2 of 3"):
        assert said in page
    assert f"return {made.returns:.1f}" in page
    assert made.gif is None
    assert [path.name for path in out.parent.iterdir()] == ["walk.html"]


def test_an_episode_follows_from_its_number(
    cheetah: Path, short, tmp_path: Path
) -> None:
    pages = []
    for number, episode in enumerate((0, 0, 1)):
        out = tmp_path / f"{number}.html"
        rewire_jax.render(cheetah, task=0, episode=episode, out=out, seconds=0)
        pages.append(out.read_text())
    assert pages[0] == pages[1]
    first, _, other = map(embedded, pages)
    assert not np.allclose(first["position"], other["position"], atol=1e-3)


def test_a_member_of_a_sweep_is_seen(short, tmp_path: Path) -> None:
    sweep = untrained(tmp_path / "sweep", CHEETAH[0], **SWEEP)
    run_folder.write(batches_of(sweep, 1), {"size": 2, "batches": [[0, 1]]})
    out = tmp_path / "x.html"
    made = rewire_jax.render(sweep, task=1, member=1, out=out, seconds=0)
    assert "member 1, after 2 of 3 tasks" in made.caption
    with pytest.raises(UserError, match=r"task 2 .*--stage 1"):
        rewire_jax.render(sweep, task=2, member=1, out=out, seconds=0)


def test_changed_sizes_are_seen(cheetah: Path, short, tmp_path: Path) -> None:
    extents = {}
    for task in (0, 1):
        out = tmp_path / f"{task}.html"
        rewire_jax.render(cheetah, task=task, out=out, seconds=0)
        extents[task] = scene(out.read_text()).geometry
    for name, mesh in extents[0].items():
        # Those of hugefoot beside those of moon: a radius half as large again.
        ratio = mesh.extents / extents[1][name].extents
        assert (ratio[0] > 1.4) == (name in FEET), (name, ratio)


def test_a_robot_s_arm_is_seen(short, tmp_path: Path) -> None:
    run = untrained(tmp_path / "run", "continual_world/t3", stage=3)
    out = tmp_path / "arm.html"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rewire_jax.render(run, task=2, episode=4, out=out, seconds=0)
        # The same episode again: the hand is the first thing that is observed.
        plan = make_scenario("continual_world/t3")
        task = plan.tasks[2].data
        env = plan.environment.make()
        act = rewire_jax.load_policy(run, task=2)
        seen = [env.reset(seed=4, options={"task": int(task.physics)})[0]]
        for _ in range(STEPS):
            seen.append(env.step(np.asarray(act(seen[-1])))[0])
    found = embedded(out.read_text())
    model = env.simulation.model
    (rail,) = [i for i in range(model.ngeom) if model.geom(i).name == "rail"]
    place = found["names"].index(f"geom{rail}")
    rails = np.array([frame[place] for frame in found["position"]])
    hands = np.array(seen)[:, :3]
    away = np.linalg.norm(rails - hands, axis=1)
    np.testing.assert_allclose(away, np.linalg.norm(model.geom_pos[rail]), atol=2e-3)
    assert np.ptp(hands, axis=0).max() > 0.01
    assert len(rails) == STEPS + 1


def test_an_animation_lies_beside_the_page(
    cheetah: Path, short, tmp_path: Path, capsys
) -> None:
    words = ["render", str(cheetah), "--task", "0", "--stage", "1"]
    main.main([*words, "--out", str(tmp_path / "x.html")])
    shown = capsys.readouterr().out
    assert str(tmp_path / "x.html") in shown
    if "no GIF" in shown:
        pytest.skip(shown)
    assert str(tmp_path / "x.gif") in shown
    with Image.open(tmp_path / "x.gif") as gif:
        assert gif.size == (400, 300)
        assert gif.n_frames == STEPS + 1


def test_a_page_is_made_where_no_animation_can_be(
    cheetah: Path, short, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    made = rewire_jax.render(cheetah, task=0, out=tmp_path / "x.html")
    assert made.gif is None
    assert re.fullmatch("no GIF: MuJoCo cannot draw.*", made.note)
    assert [path.name for path in tmp_path.iterdir()] == ["x.html"]


def test_what_cannot_be_seen(cheetah: Path, tmp_path: Path, capsys) -> None:
    sweep = untrained(tmp_path / "sweep", "probe/reach", **SWEEP)
    probe = untrained(tmp_path / "probe", "probe/reach")
    out = ["--out", tmp_path / "x.html"]

    def said(*words: object) -> str:
        return fails(capsys, "render", *words, *out)

    assert "holds no run" in said(tmp_path / "none", "--task", 0)
    assert "give member" in said(sweep, "--task", 0)
    assert "tasks 0 to 2, not 3" in said(cheetah, "--task", 3)
    assert "--stage 1" in said(cheetah, "--task", 2)
    assert "no seed 9" in said(cheetah, "--task", 0, "--seed", 9)
    assert "task 0" in said(cheetah, "--task", 0, "--stage", 0)
    assert "probe/reach" in said(probe, "--task", 0)
    assert "--task" in said(cheetah)
    assert "--episode" in said(cheetah, "--task", 0, "--episode", -1)
    assert "--seconds" in said(cheetah, "--task", 0, "--seconds", -1)
    begun = shutil.copytree(cheetah, tmp_path / "begun")
    shutil.rmtree(begun / "checkpoints")
    assert "finished no task" in said(begun, "--task", 0)
    out = ["--out", tmp_path / "x.gif"]
    assert ".html" in said(cheetah, "--task", 0)
    assert not (tmp_path / "x.html").exists()


@pytest.mark.slow
def test_a_browser_shows_it_without_a_network(
    cheetah: Path, short, tmp_path: Path
) -> None:
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip("no browser")
    page = tmp_path / "walk.html"
    rewire_jax.render(cheetah, task=0, out=page, seconds=0)

    def shot(milliseconds: int) -> np.ndarray:
        path = tmp_path / f"{milliseconds}.png"
        subprocess.run(
            [
                browser,
                "--headless",
                "--no-sandbox",
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                # Nothing is resolved, and nothing answers.
                "--host-resolver-rules=MAP * ~NOTFOUND",
                "--proxy-server=127.0.0.1:9",
                "--window-size=640,480",
                f"--virtual-time-budget={milliseconds}",
                f"--screenshot={path}",
                page.as_uri(),
            ],
            check=True,
            capture_output=True,
            timeout=300,
        )
        return np.asarray(Image.open(path).convert("RGB")).astype(int)

    early, late = shot(2000), shot(2300)
    drawn = early[:380]  # above the buttons
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 50
    assert (np.abs(early - late)[:380].max(axis=-1) > 30).sum() > 100
