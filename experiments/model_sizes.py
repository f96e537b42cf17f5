"""Each method's model size on the Brax scenarios, next to the paper's Table 1.

Nothing is trained. Each method starts and ends all tasks of each scenario with the
settings of the paper profile. Then it counts what it stores, as in a run.
"""

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rewire_jax
from experiments import suite
from rewire_jax.methods import find_method
from rewire_jax.reports import paper_results
from rewire_jax.run.evaluation import most_stored
from rewire_jax.training.run_setup import base_size, make_spec

_NO_SIZE = "updates", "segments"  # of a spec, in these runs
TITLE = "Model size: most numbers stored in a run, divided by those of a plain policy"
FORMULAS = {
    "ft1": "1",
    "ft_l2": "2: the policy, the previous one",
    "packnet": "2: the policy, the owner of each weight",
    "ewc": "3: the policy, the previous one, their Fisher diagonal",
    "pnn": "(T P(w) + (T − 1) (L + (L − 1) (w + 1) w + 2a (w + 1)) + T (T − 1) / 2 "
    "L w²) / P with w = 96: columns; scales and outer layers of the laterals; their "
    "inner layers",
    "sac_n": "T",
    "ft_n": "T",
    "csp": "anchors kept: from 1 to T",
    "rewire": "(2 (P − H) + (S + 1) H + (K + S) L n + (2L − 1) n) / P: hidden layers "
    "now and before; S heads and the current one as the task began; scores and cached "
    "orders; adapters",
}
SYMBOLS = (
    "Each method counts its own numbers, with the paper profile. A cell is the mean "
    "over the scenarios of a domain. T is the length of the sequence: 8, on Humanoid "
    "4. L = 3 hidden layers "
    "of n = 256 neurons, observations of length o, actions of length a. A plain policy "
    "of width w has P(w) = (o + 1) w + (L − 1) (w + 1) w + 2a (w + 1) numbers, P is "
    "P(n), and its head has H = 2a (n + 1) of them. K = 3 wirings and S = 4 head "
    "slots, but S = 2 in the robustness scenarios, whose tasks recur after two. "
    "Observations are those of brax.v1."
)
DIFFERENCES = (
    "Where the paper has another number:",
    "",
    "- PNN: the paper's is T. The published width is 96. The inner layers of the "
    "lateral connections grow with T². So the size is close to T for 8 tasks, but not "
    "for 4.",
    "- CSP: the number of anchors depends on the run; the paper's are means over runs.",
)


@dataclass(frozen=True, kw_only=True)
class ModelSizes:
    """What to write.

    Attributes:
      out: the result files, without a suffix.
    """

    out: Path = suite.RESULTS / "model-sizes"


def measure(name: str) -> Iterator[dict[str, Any]]:
    """A row for each method.

    Args:
      name: of the scenario.
    """
    scenario = rewire_jax.make_scenario(name)
    environment = scenario.environment
    paper = paper_results.sources(name)[0].results
    for method in FORMULAS:
        settings = rewire_jax.preset(scenario, method)
        spec = make_spec(settings, environment)
        numbers = most_stored(method, spec, settings.options.checked())
        yield {
            "scenario": name,
            "method": method,
            **{n: v for n, v in spec._asdict().items() if n not in _NO_SIZE},
            "plain": base_size(spec),
            "least": min(numbers),
            "most": max(numbers),
            "paper": paper[method].size,
        }


def table(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Means over a domain's scenarios beside the paper's, a line for each method."""
    head, lines = (
        ["method"],
        {method: [paper_results.NAMES[method]] for method in FORMULAS},
    )
    for domain in suite.DOMAINS:
        own = [row for row in rows if row["scenario"].startswith(domain)]
        lengths = dict.fromkeys(row["observations"] for row in own)
        head += [*(f"{domain}, o = {length}" for length in lengths), "paper"]
        for method, line in lines.items():
            found = [row for row in own if row["method"] == method]
            for length in lengths:
                same = [row for row in found if row["observations"] == length]
                ends = {
                    statistics.mean(row[end] / row["plain"] for row in same)
                    for end in ("least", "most")
                }
                line.append(" to ".join(f"{value:.2f}" for value in sorted(ends)))
            line.append(f"{found[0]['paper']:.1f}")
    return [
        [*head, "formula"],
        *([*line, FORMULAS[method]] for method, line in lines.items()),
    ]


def single_head(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown: why the paper's size of rewire on Humanoid is another."""
    (row,) = (
        row
        for row in rows
        if row["scenario"] == "humanoid/hard" and row["method"] == "rewire"
    )
    head = 2 * row["actions"] * (row["hidden"] + 1)
    slots = (
        find_method("rewire").preset(row["scenario"], row["tasks"], "paper").head_slots
    )
    left = (row["most"] - (slots - 1) * head) / row["plain"]
    return (
        f"- rewire: on Humanoid a head is {head / row['plain']:.3f} of a policy. With "
        f"one head instead of {slots} the size would be {left:.2f}."
    )


def run(job: ModelSizes) -> None:
    """Computes all sizes and writes them."""
    names = [name for domain in suite.DOMAINS.values() for name in domain]
    rows = [row for name in names for row in measure(name)]
    notes = (SYMBOLS, "", *DIFFERENCES, single_head(rows))
    suite.write(job.out, TITLE, table(rows), notes, rows)


if __name__ == "__main__":
    suite.command(ModelSizes, run, "model_sizes")
