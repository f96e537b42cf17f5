"""The one line that says where a result comes from."""

from collections.abc import Iterable, Mapping
from typing import Any

from rewire_jax.reports.titles import several
from rewire_jax.storage.run_results import RunData
from rewire_jax.storage.sweep_results import SweepData


def how_made(*provenances: Mapping[str, Any]) -> str:
    """Markdown: device, commit, versions, start and command of what made a result.

    Args:
        provenances: as `run_folder.provenance` gives them, of one or more results that
            are shown together.
    """

    def found(name: str) -> list[str]:
        return list(dict.fromkeys(str(each.get(name, "–")) for each in provenances))

    versions = dict.fromkeys(
        f"{package} {version}"
        for each in provenances
        for package, version in each.get("versions", {}).items()
    )
    commands = (f"`{command}`" for command in found("command"))
    parts = (
        ", ".join(found("device")),
        f"commit {', '.join(found('commit'))}",
        ", ".join(versions),
        f"started {_ends(found('started'))}",
        f"command {', '.join(commands)}",
    )
    return "; ".join(part for part in parts if part)


def origin(label: str, *results: RunData | SweepData) -> str:
    """A bullet of Markdown: where results come from that are shown as one.

    Args:
        label: what they are called.
        results: in one folder, or in folders side by side.
    """
    first = results[0]
    folder = first.folder if len(results) == 1 else first.folder.parent
    lost = [s for r in results if isinstance(r, RunData) for s in r.diverged]
    seeds = sorted({int(seed) for result in results for seed in result.seeds})
    said = f"seed{'' if len(seeds) == 1 else 's'} {_list(seeds)}"
    said += f" (diverged: {_list(lost)})" if lost else ""
    done = _ends(result.finished for result in results)
    done += f" of {several(len(first.tasks), 'task')}"
    return (
        f"- {label}: `{folder}`; {said}; {done}, "
        f"{int(first.settings['interactions']):,} interactions a task; "
        f"{how_made(*(result.provenance for result in results))}"
    )


def _list(values: Iterable[Any]) -> str:
    return ", ".join(map(str, values))


def _ends(values: Iterable[Any]) -> str:
    order = sorted(values)
    return " to ".join(dict.fromkeys(map(str, (order[0], order[-1]))))
