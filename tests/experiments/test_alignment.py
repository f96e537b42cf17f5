import jax
import pytest

from experiments.alignment import Alignment, learn


@pytest.mark.slow
def test_the_authors_form_and_matching_settle_and_the_norm_does_not():
    job = Alignment(width=64, updates=(4_000,))
    variants = ("expanded", 10, True), ("matching", 0, True), ("norm", 1, False)
    for form, rate, settles in variants:
        found = jax.jit(lambda f=form, r=rate: learn(job, f, r, 0))()
        for (value,), limit in zip(found, (0.02, 0.02, 0.1), strict=True):
            assert value < limit if settles else value > 0.3


@pytest.mark.slow
def test_matching_has_nothing_to_settle():
    job = Alignment(width=32, updates=(100, 200, 1_000))
    adapters, matched = (
        jax.jit(lambda f=form: learn(job, f, 1, 0))()
        for form in ("expanded", "matching")
    )
    for trained, solved in zip(adapters, matched, strict=True):
        assert (solved < 0.1).all()
        assert (solved[:2] < trained[:2]).all()
