"""Tasks recognised by returns: what is evaluated, and the means of it."""

import json

import pytest

import rewire_jax
from experiments import task_choice
from experiments.task_choice import TaskChoice
from tests import fake_training
from tests.fake_run import write_run
from tests.tiny import shrink_presets


def length(folder):
    return json.loads((folder / "settings.json").read_text())["episode_length"]


def seeds(folder):
    told = json.loads((folder / "settings.json").read_text())["settings"]
    return range(told["seed"], told["seed"] + told["seeds"])


def test_the_table_has_means_over_tasks_and_seeds(tmp_path, monkeypatch):
    def evaluate(folder, *, episodes, task_label, trials, trial_steps):
        assert (episodes, task_label) == (16, "none")
        right = trial_steps == length(folder) and folder.name != "sac_n"
        return [
            {
                "seed": seed,
                "task": task,
                "return": 10.0 * task,
                "chosen": {
                    "return": 10.0 * task - (not right),
                    # The last task was not trained.
                    "recognised": None if task == 2 else right or task == 0,
                    "interactions": 3 * trials * trial_steps,
                },
            }
            for seed in seeds(folder)
            for task in range(3)
        ]

    monkeypatch.setattr(rewire_jax, "train", fake_training.train)
    monkeypatch.setattr(rewire_jax, "evaluate", evaluate)
    others = [
        write_run(tmp_path / "other" / f"seed-{n}", seed=n, seeds=1) for n in (0, 1)
    ]
    job = TaskChoice(
        runs=tuple(others),
        shares=(0.001, 1.0),
        out=tmp_path / "runs",
        result=tmp_path / "result" / "table",
    )
    task_choice.run(job)
    found = json.loads(job.result.with_suffix(".json").read_text())
    assert found["provenance"]["commit"]
    means = task_choice.means(found["rows"])
    of = {(r["run"], r["trial_steps"], r["trials"]): r for r in means}
    whole = length(others[0])
    assert of.keys() == {
        (name, steps, trials)
        for name in ("rewire", "sac_n", "other")
        for steps in (1, whole)
        for trials in (1, 4)
    }
    # Tasks 0 and 1 alone: the mean return is 5 with labels.
    for (name, steps, trials), row in of.items():
        right = steps == whole and name != "sac_n"
        assert row["recognised"] == (1 if right else 0.5)
        assert row["return"] == 5 - (not right)
        assert row["labelled"] == 5
        assert row["interactions"] == 3 * trials * steps
        assert row["seeds"] == (3 if name in job.methods else 2)
    page = job.result.with_suffix(".md").read_text()
    assert page.count("| rewire |") == 4
    assert str(tmp_path / "other") in page


@pytest.mark.slow
def test_tasks_of_the_probe_are_recognised_in_long_trials(tmp_path, monkeypatch):
    shrink_presets(monkeypatch, hidden=32, interactions=6_400, updates=4)
    job = TaskChoice(
        seeds=1,
        trials=(4,),
        shares=(1.0,),
        out=tmp_path / "runs",
        result=tmp_path / "table",
    )
    task_choice.run(job)
    rows = json.loads(job.result.with_suffix(".json").read_text())["rows"]
    assert {row["run"] for row in rows} == set(job.methods)
    for row in task_choice.means(rows):
        assert row["recognised"] > 0.5
        assert row["interactions"] > 0
