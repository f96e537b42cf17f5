import json
from dataclasses import replace

import jax

from experiments import bench_speed
from rewire_jax.methods.base import Spec
from rewire_jax.plan import prepare
from rewire_jax.presets import preset
from rewire_jax.scenarios import make_scenario


def test_quick_run_writes_every_figure(tmp_path, capsys):
    out = tmp_path / "new" / "speed.json"
    bench_speed.run(bench_speed.Bench(out=out, quick=True))
    result = json.loads(out.read_text())
    loops = result["loops"]
    plain = {"square", "shapes", "plain/2"}
    assert set(loops) == plain | {"rewire/2"}
    for name, figures in loops.items():
        assert len(figures["seconds"]) == 2
        assert figures["best"] >= figures["median"] > 0
        assert ("multiply_adds" in figures) == (name in plain)
        assert ("share" in figures) == (name in plain)
        assert ("cost" in figures) == (name not in plain)
    assert loops["square"]["share"] == 1
    assert {"commit", "versions", "device", "load"} <= set(result)
    assert result["options"]["modes"] == 3
    printed = capsys.readouterr().out
    assert str(out) in printed
    assert all(name in printed for name in loops)


def test_multiply_adds_by_hand():
    spec = Spec(observations=2, actions=1, hidden=5, depth=1, tasks=1)
    critics, policy = map(bench_speed.multiply_adds, bench_speed.products(spec, 7))
    p, c = 2 * 5 + 5 * 2, 3 * 5 + 5
    assert critics == 7 * (p + 2 * (4 * c - 3 * 5))
    assert policy == 7 * (3 * p - 2 * 5 + 2 * (2 * c - 2 * 5))


def test_multiply_adds_are_those_of_the_compiled_update():
    settings = preset(make_scenario(bench_speed.SCENARIO), "ft1")
    sizes = replace(settings.sac, hidden=128, depth=2, batch_size=128)
    settings = replace(settings, sac=sizes)
    state, advance, batches = bench_speed.updates(settings)
    compiled = jax.jit(advance).lower(state, batches, 3).compile()
    # XLA counts the body of a loop once, of a branch the dearer side, and what is not
    # a matrix product too.
    counted = compiled.cost_analysis()["flops"]
    critics, policy = bench_speed.products(prepare(settings).spec, 128)
    expected = 2 * bench_speed.multiply_adds(critics + policy)
    assert expected < counted < 1.15 * expected
