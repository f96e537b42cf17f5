"""Follows README.md in an empty folder, word for word, as a newcomer would.

Its shell and Python blocks are run in their order, as they stand, with a home and a
path of their own; this repository's last commit answers for the address that it has
cloned. What is written under `runs/` or `site/`, as a section tells, must be there once
its blocks have been run. Blocks after a paragraph that begins with "For later" in bold
are left out. Run by `make follow-readme`.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from experiments import suite
from rewire_jax.core.errors import UserError
from rewire_jax.core.settings import require

ROOT = Path(__file__).resolve().parent.parent
LATER = "**For later"
_PARTS = re.compile(r"^```(\w+)\n(.*?)^```|^#+ (.*?)$", re.DOTALL | re.MULTILINE)
_TOLD = re.compile(r"`((?:runs|site)/[\w./-]*)`")
# How this machine reaches others is nothing that a README could know.
_KEPT = ("PIP_", "SSL_CERT_", "HTTP_PROXY", "HTTPS_PROXY", "NO_PROXY")


@dataclass(frozen=True, kw_only=True)
class Follow:
    """What to follow.

    Attributes:
      only: sections whose titles begin so; all if none are given.
      skip: sections whose titles begin so are left out.
      folder: where; one that an earlier call left is gone on with. A new one, deleted
        in the end, if not given.
      keep: put the result under experiments/results instead of runs, to be committed.
    """

    only: tuple[str, ...] = ()
    skip: tuple[str, ...] = ()
    folder: Path | None = None
    keep: bool = False


class Section(NamedTuple):
    """A part of the README that has blocks.

    Attributes:
      title: its heading.
      blocks: language and text of each that is to be run.
      told: paths that it tells of.
    """

    title: str
    blocks: list[tuple[str, str]]
    told: list[str]


class Done(NamedTuple):
    """What became of a block, or of a path that was told of."""

    section: str
    what: str
    well: bool
    status: int | None = None
    seconds: float | None = None


def sections(text: str) -> list[Section]:
    """The sections of a Markdown page that have blocks to run."""
    found = [Section("", [], [])]
    end = 0
    for part in _PARTS.finditer(text):
        said, end = text[end : part.start()], part.end()
        found[-1].told.extend(_TOLD.findall(said))
        language, code, title = part.groups()
        if title:
            found.append(Section(title, [], []))
        elif not said.strip().rpartition("\n\n")[2].startswith(LATER):
            found[-1].blocks.append((language, code))
    found[-1].told.extend(_TOLD.findall(text[end:]))
    return [section for section in found if section.blocks]


def chosen(
    found: Sequence[Section], only: Sequence[str], skip: Sequence[str]
) -> list[Section]:
    """The sections whose titles begin with one of `only`, and with none of `skip`.

    Raises:
      UserError: nothing begins so.
    """
    for name in (*only, *skip):
        known = ", ".join(section.title for section in found)
        require(
            any(section.title.startswith(name) for section in found),
            f"no section with blocks begins with {name!r}: there are {known}",
        )
    return [
        section
        for section in found
        if not section.title.startswith(tuple(skip))
        and (not only or section.title.startswith(tuple(only)))
    ]


def newcomer(folder: Path, answers: Mapping[str, Path]) -> dict[str, str]:
    """The environment of someone who has just come.

    Args:
      folder: for a home.
      answers: repositories on this machine, by the addresses that they answer for.
    """
    home = folder / "home"
    home.mkdir(parents=True, exist_ok=True)
    for address, repository in answers.items():
        name = f"url.{repository.resolve().as_uri()}.insteadOf"
        config = ["git", "config", "--file", str(home / ".gitconfig"), name, address]
        subprocess.run(config, check=True)
    kept = {k: v for k, v in os.environ.items() if k.upper().startswith(_KEPT)}
    found = [shutil.which(tool) for tool in ("git", "make")]
    tools = [str(Path(tool).parent) for tool in found if tool]
    path = dict.fromkeys([f"{sys.base_prefix}/bin", *tools, "/usr/bin", "/bin"])
    return kept | {"HOME": str(home), "PATH": os.pathsep.join(path), "LANG": "C.UTF-8"}


def follow(
    found: Sequence[Section],
    folder: Path,
    environment: Mapping[str, str],
    python: str,
) -> Iterator[Done]:
    """Runs the blocks of sections, each where the one before has ended.

    Args:
      found: what to run.
      folder: for the blocks as files, and for `here`, where the first begins.
      environment: of every block.
      python: what runs a file of Python.
    """
    here, place = folder / "here", folder / "place"
    if not place.exists():
        here.mkdir(parents=True)
        place.write_text(f"{here}\n")
    for section in found:
        for language, code in section.blocks:
            block = folder / f"block.{language}"
            block.write_text(code)
            if language == "python":
                command = f"{python} {shlex.quote(str(block))}"
            else:
                # On lines of their own: -e passes over what stands before an &&.
                command = f". {shlex.quote(str(block))}\npwd >{shlex.quote(str(place))}"
            print(f"\n[{section.title}]\n{code}", flush=True)
            start = time.monotonic()
            done = subprocess.run(
                ["sh", "-e", "-c", command],
                cwd=place.read_text().removesuffix("\n"),
                env=dict(environment),
                stdin=subprocess.DEVNULL,
                check=False,
            )
            first = code.strip().splitlines()[0].removesuffix(" \\")
            status, seconds = done.returncode, time.monotonic() - start
            yield Done(section.title, first, status == 0, status, seconds)
        for path in section.told:
            there = (Path(place.read_text().removesuffix("\n")) / path).exists()
            yield Done(section.title, f"{path} is there", there)


def run(job: Follow) -> None:
    """Follows the README as it was committed last, and writes what came of it.

    Raises:
      UserError: wrong arguments, or something did not go as the README says.
    """
    show = ["git", "-C", str(ROOT), "show", "HEAD:README.md"]
    committed = subprocess.run(show, capture_output=True, text=True, check=False)
    require(
        committed.returncode == 0, f"{ROOT} is no clone: {committed.stderr.strip()}"
    )
    text = committed.stdout
    answers = dict.fromkeys(re.findall(r"^git clone (\S+)", text, re.MULTILINE), ROOT)
    (python,) = re.findall(r"`(\S+) FILE`", text)
    every = sections(text)
    taken = chosen(every, job.only, job.skip)
    with tempfile.TemporaryDirectory(prefix="readme-") as temporary:
        folder = (job.folder or Path(temporary)).resolve()
        done = list(follow(taken, folder, newcomer(folder, answers), python))
    left = [section.title for section in every if section not in taken]
    suite.write(
        (suite.RESULTS if job.keep else Path("runs")) / "readme-followed",
        "The README, followed in an empty folder",
        [
            ["section", "block, or file", "went well", "exit status", "seconds"],
            *(
                [
                    each.section,
                    f"`{each.what}`",
                    "yes" if each.well else "**no**",
                    "–" if each.status is None else str(each.status),
                    "–" if each.seconds is None else f"{each.seconds:.0f}",
                ]
                for each in done
            ),
        ],
        [f"Left out: {', '.join(left) or 'nothing'}. Blocks go by their first lines."],
        [each._asdict() for each in done],
    )
    wrong = [f"{each.section}: {each.what}" for each in done if not each.well]
    if wrong:
        raise UserError(f"not as the README says: {'; '.join(wrong)}")


if __name__ == "__main__":
    suite.command(Follow, run, "follow_readme")
