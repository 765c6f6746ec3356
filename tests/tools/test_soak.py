"""A short form of ``python tests/tools/soak.py``; the full one is in tests/README.md."""

import os
import subprocess
import sys
import tempfile

import numpy as np
import pytest
import soak

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="it reads /proc")


def test_nothing_grows():
    counts = ["--steps=100000", "--resets=20000", "--cycles=200", "--crashes=60"]
    done = subprocess.run(
        [sys.executable, soak.__file__, *counts], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("\n") == 2 + len(soak.SOAKS)


def test_what_grows_is_found(monkeypatch, tmp_path):
    """The reference is able to fail."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # others use the common one
    monkeypatch.setattr(soak, "SAMPLES", 40)
    kept, descriptors = [], []

    def work():
        for _ in range(soak.SAMPLES):
            kept.append(np.ones(250_000))  # much: others may have left free memory
            descriptors.append(os.open(os.devnull, os.O_RDONLY))
            yield

    grown = soak.measure(work())
    for descriptor in descriptors:
        os.close(descriptor)
    assert soak.leaks(grown) == ["memory", "descriptors"]
    assert grown["descriptors"].amount == pytest.approx(soak.SAMPLES / 2, rel=0.2)


def test_what_does_not_grow_is_zero():
    """However much it varies, and whatever there was in the first half."""
    noise = np.random.default_rng(0).normal(size=soak.SAMPLES)
    beginning = np.r_[np.arange(100.0), np.full(100, 100.0)]
    for samples in (np.ones(soak.SAMPLES), noise, beginning):
        assert soak.growth(samples).is_zero(0.0)
    assert soak.growth(np.ones(soak.SAMPLES)) == (0.0, 0.0)
    assert not soak.growth(noise + np.arange(soak.SAMPLES)).is_zero(0.0)
