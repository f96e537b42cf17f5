"""Shared code of the paper's Tables 1 and 2: methods, averaged over scenarios.

All runs are trained one after the other; a stopped run is continued. The table is made
only from the files of the runs; with `--no-train`, from those that exist.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments import averages, suite
from rewire_jax.core.arguments import require
from rewire_jax.reports import paper_results
from rewire_jax.storage.scores import Success


@dataclass(frozen=True, kw_only=True)
class Table(suite.Experiment):
    """What to run.

    Attributes:
      scenarios: names of the scenarios.
      methods: names of the methods, or "all" for those of the paper.
    """

    scenarios: tuple[str, ...]
    methods: tuple[str, ...] = ("all",)

    def runs_of(
        self, groups: Mapping[str, str], always: Sequence[str] = ()
    ) -> dict[str, list[suite.Run]]:
        """The runs by the name of their group, all methods of a scenario together.

        Args:
          groups: that of each scenario.
          always: methods that run whether they are asked for or not.

        Raises:
          UserError: wrong arguments.
        """
        every = paper_results.NAMES
        methods = every if "all" in self.methods else (*always, *self.methods)
        variants: suite.Variants = {method: (method, {}) for method in methods}
        found: dict[str, list[suite.Run]] = {}
        for name, group in groups.items():
            found.setdefault(group, []).extend(self.runs(name, variants))
        require(bool(found), "name at least one scenario")
        return found


def write(
    job: Table,
    groups: Mapping[str, Sequence[suite.Run]],
    kind: str,
    title: str,
    reading: str,
    path: Path,
    success: Success = "any",
) -> None:
    """Trains what is not finished, and writes a report a scenario and the table.

    Args:
      job: what was asked for.
      groups: runs by the name of the group over whose scenarios they are averaged.
      kind: what a group is.
      title: above the table.
      reading: Markdown below it.
      path: of the table, without a suffix; reports stand beside it.
      success: see `rewire_jax.write_report`.

    Raises:
      UserError: wrong arguments.
      rewire_jax.Stopped: interrupted; the same command continues.
    """
    done = suite.train([run for runs in groups.values() for run in runs], job)
    head, reports, rows = ["method"], [], []
    methods = dict.fromkeys(r.folder.name for runs in groups.values() for r in runs)
    lines = {method: [paper_results.NAMES.get(method, method)] for method in methods}
    for group, runs in groups.items():
        made = suite.reports([run for run in runs if run in done], path.parent, success)
        reports += made
        found = averages.over_scenarios(made)
        sources = paper_results.sources(runs[0].settings.scenario)
        sized = not sources or sources[0].sized
        head += [group, "model size", "paper"]
        head += ["paper's model size"] if sized else []
        for method, line in lines.items():
            ours = found.get(method)
            theirs = sources[0].results.get(method) if sources else None
            line += [
                averages.text(ours, len(runs) // len(methods)),
                averages.size(ours),
                averages.text(theirs),
            ]
            line += [averages.size(theirs)] if sized else []
            rows.append(
                {kind: group, "method": method}
                | averages.columns("", ours)
                | averages.columns("paper_", theirs)
            )
    notes = (reading, "", *suite.origins(reports))
    suite.write(path, title, [head, *lines.values()], notes, rows)
