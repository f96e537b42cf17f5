from pathlib import Path

import pytest

from rewire_jax.core.machine_memory import machine_bytes


@pytest.mark.parametrize(
    ("groups", "file", "text", "limit"),
    [
        ("0::/user/me", "sys/fs/cgroup/user/memory.max", "1000000", 1_000_000),
        ("0::/user/me", "sys/fs/cgroup/user/memory.max", "max", None),
        ("0::/outside", "sys/fs/cgroup/memory.max", "1000000", 1_000_000),
        (
            "5:cpu:/\n4:cpuset,memory:/me",
            "sys/fs/cgroup/memory/me/memory.limit_in_bytes",
            "1000000",
            1_000_000,
        ),
        ("5:cpu:/me", "sys/fs/cgroup/memory/me/memory.limit_in_bytes", "1000", None),
    ],
)
def test_machine_gives_no_more_than_its_control_groups(
    tmp_path: Path, groups, file, text, limit
):
    whole = machine_bytes(tmp_path)
    assert whole > 1e8
    for name, written in (("proc/self/cgroup", groups), (file, text)):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(written + "\n")
    assert machine_bytes(tmp_path) == (limit or whole)
