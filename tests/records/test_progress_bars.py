"""Progress bars count whole steps."""

import io
import sys

import pytest

from fmugym.records.progress_bars import progress_bar


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_parts_of_steps_are_rounded(monkeypatch):
    pytest.importorskip("tqdm", reason="needs the extra sb3")
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr("tqdm.tqdm.monitor_interval", 0)
    seen = []
    with progress_bar(10 / 3, "fit", "simulations") as advance:
        bar = next(
            one.cell_contents for one in advance.__closure__ if hasattr(one.cell_contents, "n")
        )
        bar.delay, bar.mininterval = 0, 0
        for _ in range(10):
            advance(1 / 3)
            seen.append(bar.n)
    assert seen == [0, 1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert bar.total == 3
    assert all(isinstance(one, int) for one in seen)
    shown = terminal.getvalue()
    assert "3/3" in shown
    assert "." not in shown.rpartition("3/3")[2].partition("[")[0]
