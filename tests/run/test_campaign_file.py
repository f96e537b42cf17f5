import dataclasses
from pathlib import Path

import pytest

from rewire_jax.core.errors import UserError
from rewire_jax.envs.scenarios import make_scenario
from rewire_jax.run.campaign_file import as_populations, read_campaign
from rewire_jax.training.presets import preset

TWO = """
title = "Two methods"
tuned_on = ["probe/reach"]

[[runs]]
scenarios = ["probe/reach"]
methods = ["ft1"]
seeds = [3, 4, 7]
profile = "quick"

[[runs]]
scenarios = ["probe/reach"]
methods = ["rewire"]
name = "Rewire, K = 1"
seeds = 2
priority = -1
profile = "quick"
[runs.settings]
modes = 1
lr-policy = 1e-3
caching = false
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "campaign.toml"
    path.write_text(text)
    return path


def test_runs_come_by_priority_then_turn(tmp_path):
    made = read_campaign(write(tmp_path, TWO))
    assert (made.title, made.tuned_on) == ("Two methods", ("probe/reach",))
    assert [run.name for run in made.runs] == [
        "probe/reach/rewire-k-1/seed-0",
        "probe/reach/rewire-k-1/seed-1",
        "probe/reach/ft1/seed-3",
        "probe/reach/ft1/seed-4",
        "probe/reach/ft1/seed-7",
    ]


def test_settings_are_the_presets_with_what_the_entry_says(tmp_path):
    run = read_campaign(write(tmp_path, TWO)).runs[1]
    plain = preset(make_scenario("probe/reach"), "rewire", "quick")
    assert run.settings.seed == 1
    assert run.settings.interactions == plain.interactions
    assert run.settings.sac == dataclasses.replace(plain.sac, lr_policy=1e-3)
    assert run.settings.options.modes == 1
    assert not run.settings.options.caching
    assert run.settings.options.beta == plain.options.beta


def test_words_are_those_of_the_command(tmp_path):
    words = read_campaign(write(tmp_path, TWO)).runs[1].words()
    assert words[:2] == ["train", "probe/reach"]
    assert "--no-caching" in words
    for flag, value in {"--modes": "1", "--seed": "1", "--profile": "quick"}.items():
        assert words[words.index(flag) + 1] == value


def test_consecutive_seeds_become_a_population(tmp_path):
    made = read_campaign(write(tmp_path, TWO))
    together = as_populations(made.runs)
    assert [run.name for run in together] == [
        "probe/reach/rewire-k-1/seeds-0-1",
        "probe/reach/ft1/seeds-3-4",
        "probe/reach/ft1/seed-7",
    ]
    assert sum(len(run.seeds) for run in together) == len(made.runs)


def test_seeds_that_notice_changes_themselves_stay_alone(tmp_path):
    more = '[runs.settings]\nboundaries = "detected"\nselection-episodes = 0'
    more += "\ninteractions = 64000"
    text = TWO.replace("[runs.settings]", more, 1)
    made = read_campaign(write(tmp_path, text))
    together = as_populations(made.runs)
    assert [run.name for run in together][:2] == [
        "probe/reach/rewire-k-1/seed-0",
        "probe/reach/rewire-k-1/seed-1",
    ]
    assert sum(len(run.seeds) for run in together) == len(made.runs)


ENTRY = '[[runs]]\nscenarios = ["probe/reach"]\nmethods = ["ft1"]\n'
OTHER = ENTRY.replace("ft1", "rewire")


@pytest.mark.parametrize(
    ("text", "place", "named"),
    [
        ("title = two", "line 1", "TOML"),
        ("", "", "runs"),
        ("titel = 1\n" + ENTRY, "", "titel"),
        ("title = 1\n" + ENTRY, "", "title"),
        ('population = "both"\n' + ENTRY, "", "always"),
        ('tuned_on = ["probe/leap"]\n' + ENTRY, "", "probe/leap"),
        (ENTRY + "\n" + ENTRY, "line 5, [[runs]] number 2", "ft1"),
        (OTHER + ENTRY.replace("ft1", "ft9"), "number 2", "ft9"),
        (ENTRY.replace("reach", "leap"), "line 1", "probe/leap"),
        (ENTRY + "seeds = 0\n", "line 1", "seeds"),
        (ENTRY + "seeds = [1, 1]\n", "line 1", "twice"),
        (ENTRY + "seeds = [-1]\n", "line 1", "seeds"),
        (ENTRY + "seeds = true\n", "line 1", "seeds"),
        (ENTRY + "seeds = 1000000000000000\n", "line 1", "4096"),
        (ENTRY + "seeds = [2147483648]\n", "line 1", "2147483647"),
        ("a = " + "[" * 5000, "", "TOML"),
        (ENTRY + "[runs.settings]\nseed = 1\n", "line 1", "seed"),
        (ENTRY + "[runs.settings]\nmodes = 1\n", "line 1", "modes"),
        (
            ENTRY + "[runs.settings]\nlr-policy = 1e-3\nlr_policy = 1e-4\n",
            "line 1",
            "twice",
        ),
        (ENTRY + "[runs.settings]\ninteractions = 0\n", "line 1", "--interactions"),
        (ENTRY + "[runs.settings]\nbatch_size = 0\n", "line 1", "--batch-size"),
        (ENTRY + '[runs.settings]\nhidden = "wide"\n', "line 1", "hidden"),
        (ENTRY + 'name = "../.."\n', "line 1", "name"),
        (ENTRY + f'name = "{"x" * 300}"\n', "line 1", "name"),
        (ENTRY + 'backend = "v1"\n', "line 1", "--backend"),
        (
            ENTRY.replace('["ft1"]', '["ft1", "rewire"]') + 'name = "x"',
            "line 1",
            "name",
        ),
    ],
)
def test_what_is_wrong_is_told_with_its_place(tmp_path, text, place, named):
    path = write(tmp_path, text)
    with pytest.raises(UserError) as error:
        read_campaign(path)
    said = str(error.value)
    assert said.startswith(str(path))
    assert place in said
    assert named in said
    assert "\n" not in said


def test_two_configurations_of_a_name_are_refused(tmp_path):
    other = ENTRY + "seeds = [5]\n[runs.settings]\nenvs = 8\n"
    with pytest.raises(UserError, match="name"):
        read_campaign(write(tmp_path, ENTRY + other))


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(UserError, match=r"none\.toml"):
        read_campaign(tmp_path / "none.toml")


def test_a_file_that_is_not_text(tmp_path):
    path = tmp_path / "campaign.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="TOML"):
        read_campaign(path)
