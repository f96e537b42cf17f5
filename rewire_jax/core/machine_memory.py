"""The memory that this process may use."""

import os
import resource
import sys
from collections.abc import Iterator
from pathlib import Path


def machine_bytes(root: Path = Path("/")) -> int:
    """Bytes of the machine's memory, or of this process's share of it (cgroups).

    Args:
      root: root of the file system.
    """
    pages, page = os.sysconf("SC_PHYS_PAGES"), os.sysconf("SC_PAGE_SIZE")
    return min([pages * page, address_limit() or sys.maxsize, *_limits(root)])


def address_limit() -> int | None:
    """Bytes that this process may map, as by `ulimit -v`; None if there is no limit."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if limit == resource.RLIM_INFINITY else limit


def _limits(root: Path) -> Iterator[int]:
    """Limits of the process's control groups, in both versions of cgroups."""
    try:
        groups = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:  # not Linux
        return
    for group in groups:
        _, controllers, path = group.split(":", 2)
        if "memory" in controllers.split(","):
            top, name = root / "sys/fs/cgroup/memory", "memory.limit_in_bytes"
        elif not controllers:
            top, name = root / "sys/fs/cgroup", "memory.max"
        else:
            continue
        inner = top / path.lstrip("/")
        for folder in (inner, *inner.parents):
            # In a container, the path may be that of the machine outside.
            text = _text(folder / name)
            if text.isdecimal():  # not "max"
                yield int(text)


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""
