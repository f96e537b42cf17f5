import pytest

from rewire_jax import UserError, register_method
from rewire_jax.methods import METHODS, Entry


def test_a_name_belongs_to_one_method(monkeypatch: pytest.MonkeyPatch) -> None:
    ft1, rewire = METHODS["ft1"], METHODS["rewire"]
    monkeypatch.setitem(METHODS, "mine", ft1)
    register_method("mine", ft1)  # the same again, as in a notebook
    with pytest.raises(UserError, match="rewire"):
        register_method("rewire", ft1)
    assert METHODS["rewire"] is rewire
    other = Entry(ft1.make, ft1.settings, lambda *_: ft1.settings())
    with pytest.raises(UserError, match="mine"):
        register_method("mine", other)
