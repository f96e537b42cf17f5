from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

from experiments import memory_needs, suite
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import Settings
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.methods import METHODS
from rewire_jax.training import memory_estimate
from rewire_jax.training.presets import preset
from rewire_jax.training.run_setup import Plan, prepare
from rewire_jax.training.time_estimate import least_hours
from tests.tiny import tiny

FOUR = 4  # bytes of a number


def settings(method: str = "rewire", **changes) -> Settings:
    """Of a run that is large enough for its arrays to outweigh what goes with them."""
    small = tiny(method=method)
    sac = replace(small.sac, hidden=64, batch_size=128)
    return replace(small, sac=sac, **{"seeds": 1, **changes})


def needed(method: str = "rewire", **changes) -> memory_estimate.Need:
    return memory_estimate.need(prepare(settings(method, **changes)))


def planned(plan: Plan) -> tuple[float, float]:
    """Bytes a member that XLA plans for, in training and in an evaluation."""
    program, members = plan.program, plan.stacked
    task = jax.tree.map(lambda leaf: leaf[0], plan.tasks)
    learner = program.init(members)
    state = program.begin(members, learner, jnp.ones(plan.num_slots, bool), 0, task)
    policies = program.policies(members, learner)
    keys = jax.vmap(lambda key: jax.random.split(key, len(plan.names)))(members.keys)

    def play(tasks, policies, keys):
        episodes = plan.settings.eval_episodes
        return program.rollout(tasks, policies, keys, episodes)

    def taken(lowered):
        analysis = lowered.compile().memory_analysis()
        both = analysis.argument_size_in_bytes + analysis.temp_size_in_bytes
        return both / plan.num_slots

    return (
        taken(program.chunk.lower(members, state, 0, task, 0, 2)),
        taken(jax.jit(play).lower(plan.tasks, policies, keys)),
    )


@pytest.mark.parametrize("seeds", [1, pytest.param(8, marks=pytest.mark.slow)])
def test_estimate_is_near_what_is_compiled(seeds):
    plan = prepare(settings(seeds=seeds))
    need, (training, evaluation) = memory_estimate.need(plan), planned(plan)
    estimate = need.learner + need.buffer + need.environments + need.work
    # With more members XLA fuses more.
    assert training / 1.3 < estimate < training * 1.4
    assert evaluation / 1.3 < need.evaluation < evaluation * 1.3


@pytest.mark.slow
def test_a_share_of_all_policies_is_paid_for_once():
    small = settings("pnn", tasks=4)
    options = replace(small.options, width=64)
    plan = prepare(replace(small, options=options))
    need, (_, evaluation) = memory_estimate.need(plan), planned(plan)
    assert evaluation / 1.5 < need.evaluation < evaluation * 1.5


def test_members_need_the_same_together_as_alone():
    assert needed(seeds=3) == needed()


@pytest.mark.parametrize("method", sorted(METHODS))
def test_every_method_can_be_counted(method):
    need = needed(method)
    assert min(need) > 0
    assert need.total >= need.learner + need.buffer + need.work


def test_buffer_is_what_a_hand_counts():
    plan = prepare(settings(interactions=64_000))
    # Each row holds, for each environment, observation, action, reward and two flags.
    o, a = plan.spec.observations, plan.spec.actions
    row = 16 * (FOUR * (o + a + 1) + 2)
    assert memory_estimate.need(plan).buffer == pytest.approx(4000 * row, rel=0.02)


def test_twice_the_buffer_environments_and_episodes():
    once = needed("ft1", interactions=64_000)
    assert needed("ft1", interactions=128_000).buffer == pytest.approx(
        2 * once.buffer, rel=0.02
    )
    assert needed("ft1", envs=32).environments == 2 * once.environments
    # Policies are needed whatever the episodes.
    one, three, five = (needed("ft1", eval_episodes=n).evaluation for n in (1, 3, 5))
    assert five - three == three - one > 0


def test_width_costs_what_a_hand_counts():
    def learner(width):
        small = settings("ft1")
        plan = prepare(replace(small, sac=replace(small.sac, hidden=width)))
        return memory_estimate.need(plan).learner, plan.spec

    (narrow, spec), (wide, _) = learner(64), learner(128)

    def layers(inputs, outputs, n):
        hidden = (inputs + 1) * n + (spec.depth - 1) * (n + 1) * n
        return hidden + (n + 1) * outputs

    def numbers(n):
        o, a = spec.observations, spec.actions
        # Adam keeps two moments; critics are two, and so are their targets.
        return 3 * layers(o, 2 * a, n) + 4 * 2 * layers(o + a, 1, n)

    assert wide - narrow == FOUR * (numbers(128) - numbers(64))


def test_selection_is_paid_for_while_the_buffer_is_held():
    plain = needed(selection_episodes=12)
    many = needed(selection_episodes=12_000)
    assert many.work > 10 * plain.work
    assert many.total > plain.total
    assert needed("ft1", selection_episodes=12_000) == needed("ft1")


def test_total_is_the_larger_of_training_and_evaluation():
    need = memory_estimate.Need(1_000_000, 20_000_000, 300_000, 4_000_000, 5_000_000)
    assert need.total == 25_300_000
    assert need._replace(evaluation=50_000_000).total == 51_000_000
    assert str(need).startswith("a member needs 25.3 MB: learner 1, buffer 20, ")


def test_most_that_is_alive_at_once():
    x = jax.ShapeDtypeStruct((100,), jnp.float32)
    one = 100 * FOUR

    def chain(x):
        for _ in range(5):
            x = jnp.sin(x)
        return x

    def together(x):
        terms = [jnp.sin(x), jnp.cos(x), jnp.tan(x)]
        return terms[0] * terms[1] * terms[2]

    assert memory_estimate.peak(lambda x: x, x) == 0
    assert memory_estimate.peak(jnp.sin, x) == one
    # Each result replaces the one before it; or all are needed, and the first product.
    assert memory_estimate.peak(chain, x) == 2 * one
    assert memory_estimate.peak(together, x) == 4 * one
    assert memory_estimate.peak(jax.jit(together), x) == 4 * one
    # A loop keeps what it carries until the next is made.
    looped = memory_estimate.peak(
        lambda x: jax.lax.fori_loop(0, 9, lambda _, x: chain(x), x), x
    )
    assert looped == pytest.approx(3 * one, abs=3 * FOUR)


class Device(SimpleNamespace):
    """A device that tells no more than it is given."""

    def memory_stats(self):
        return self.stats


def devices(number, platform="gpu", **stats):
    kind = f"some {platform}"
    return [Device(platform=platform, stats=stats, device_kind=kind)] * number


def test_as_many_members_as_the_devices_hold():
    need = needed()
    total = need.total
    # Four fifths of a device are ours; no member is cut in two.
    limit = int(3.5 * total / 0.8)
    assert memory_estimate.device_bytes(devices(2, bytes_limit=limit)) == pytest.approx(
        7 * total
    )
    assert memory_estimate.fitting(need, devices(1, bytes_limit=limit)) == 3
    assert memory_estimate.fitting(need, devices(2, bytes_limit=limit)) == 6
    with pytest.raises(UserError, match=r"a member needs .* lower --buffer"):
        memory_estimate.fitting(need, devices(1, bytes_limit=total))
    with pytest.raises(UserError, match="--members-per-batch"):
        memory_estimate.fitting(need, devices(1))


def test_devices_of_a_cpu_share_the_machine(monkeypatch):
    need = needed()
    total = need.total
    cpus = devices(4, "cpu")
    monkeypatch.setattr(
        memory_estimate, "machine_bytes", lambda: int(10.5 * total / 0.8)
    )
    assert memory_estimate.fitting(need, cpus[:1]) == 8
    assert memory_estimate.fitting(need, cpus) == 10
    monkeypatch.setattr(memory_estimate, "machine_bytes", lambda: 1000 * total)
    assert memory_estimate.fitting(need, cpus[:1]) == 8
    assert memory_estimate.fitting(need, cpus) == 32


def test_a_sweep_that_no_machine_can_train_is_refused(tmp_path: Path) -> None:
    plan = prepare(settings(seeds=1))
    memory_estimate.check_sweep(plan, 1000, tmp_path / "new" / "sweep")
    with pytest.raises(UserError, match=r"1,000,000,000 members .* GB .* years"):
        memory_estimate.check_sweep(plan, 10**9, tmp_path / "new" / "sweep")
    assert not (tmp_path / "new").exists()


def test_hours_are_those_of_the_updates() -> None:
    one, other = (prepare(settings(updates=n)) for n in (4, 8))
    hours = least_hours(one, 1)
    assert 0 < hours < 1e-6 * 365.25 * 24
    assert least_hours(one, 7) == pytest.approx(7 * hours)
    assert least_hours(other, 1) == pytest.approx(2 * hours)


def test_episodes_are_played_in_parts_that_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = prepare(tiny(method="ft1"))
    learner = jax.eval_shape(plan.program.init, plan.stacked)
    policies = jax.eval_shape(plan.program.policies, plan.stacked, learner)
    assert memory_estimate.episodes_at_once(plan, policies, 4, 50) == 50
    monkeypatch.setattr(memory_estimate, "machine_bytes", lambda: 1_000_000)
    many = memory_estimate.episodes_at_once(plan, policies, 4, 100_000)
    assert 1 < many < 100_000
    monkeypatch.setattr(memory_estimate, "machine_bytes", lambda: 100)
    with pytest.raises(UserError, match="memory"):
        memory_estimate.episodes_at_once(plan, policies, 4, 100)


def test_table_of_needs_has_what_is_counted():
    scenario = make_scenario("probe/reach")
    row = memory_needs.count(scenario, "ft1", envs=32)
    plan = prepare(replace(preset(scenario, "ft1"), envs=32, seeds=1), scenario)
    assert row["total"] == memory_estimate.need(plan).total
    head, line = suite.table([row], memory_needs.COLUMNS)
    assert line[:3] == ["probe/reach", "FT-1", "32"]
    assert dict(zip(head, line, strict=True))["total"] == f"{row['total'] / 1e6:.1f}"
