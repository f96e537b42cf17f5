"""What runs are measured by: the return, or how often a task is solved."""

from typing import Literal, NamedTuple

Success = Literal["any", "last"]


class Score(NamedTuple):
    """A measure of how well a task is done.

    Attributes:
        name: of its values in a run's tables and in results.
        noun: what a value is.
        unit: what values are measured in where SAC-N does not normalise them.
        normalised: whether SAC-N normalises them where it can.
        limits: between which all values are; None where there is no such range.
        training: what progress reports have of it.
        stepwise: whether that is of a step, and an episode has as much at each.
        evaluated: a sentence, what values at the end of training are.
        trained: what curves of training show.
    """

    name: str
    noun: str
    unit: str
    normalised: bool
    limits: tuple[float, float] | None
    training: str
    stepwise: bool
    evaluated: str
    trained: str


RETURN = Score(
    name="return",
    noun="return",
    unit="raw return",
    normalised=True,
    limits=None,
    training="reward",
    stepwise=True,
    evaluated="Returns are deterministic evaluations.",
    trained="training reward a step × steps of an episode",
)


def _success(name: str, noun: str, where: str) -> Score:
    return Score(
        name=name,
        noun=noun,
        unit=noun,
        normalised=False,
        limits=(0.0, 1.0),
        training=name,
        stepwise=False,
        evaluated=f"Success rates are shares of episodes solved {where}, in "
        "deterministic evaluations.",
        trained="share of the training episodes between two reports that were solved "
        f"{where}",
    )


SUCCESS: dict[Success, Score] = {
    "any": _success("success", "success rate", "at any of their steps"),
    "last": _success(
        "success_last", "success rate at the last step", "at their last step"
    ),
}
"""By which steps of an episode count."""

SCORES = (*SUCCESS.values(), RETURN)
