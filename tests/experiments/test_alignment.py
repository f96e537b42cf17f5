import jax
import pytest

from experiments.alignment import Alignment, learn


@pytest.mark.slow
def test_the_authors_form_settles_and_the_norm_does_not():
    job = Alignment(width=64, updates=(4_000,))
    for form, rate, settles in (("expanded", 10, True), ("norm", 1, False)):
        distance, moving = jax.jit(lambda f=form, r=rate: learn(job, f, r, 0))()
        if settles:
            assert distance[0] < 0.02
            assert moving[0] < 0.02
        else:
            assert distance[0] > 0.3
            assert moving[0] > 0.3
