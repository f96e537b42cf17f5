"""The paper's results, to compare with those of runs."""

from typing import NamedTuple

# Methods as the paper calls them.
NAMES = {
    "ft1": "FT-1",
    "ft_l2": "FT-L2",
    "packnet": "PackNet",
    "ewc": "EWC",
    "pnn": "PNN",
    "sac_n": "SAC-N",
    "ft_n": "FT-N",
    "csp": "CSP",
    "rewire": "Ours (rewire)",
}
LABELS = NAMES | {
    "rewire_tuned": "Rewire, tuned",
    "cka": "CKA-RL",
    "clonex": "ClonEx-SAC",
    "reset_distill": "Reset & Distill",
}
"""The names in reports; methods of other papers are named as there."""


class Figures(NamedTuple):
    """A method's published result.

    Attributes:
        mean: performance, in the unit of its source.
        std: its standard deviation over seeds.
        size: model size in plain policies; None where it was not published.
    """

    mean: float
    std: float
    size: float | None = None


class Source(NamedTuple):
    """Results that were published together.

    Attributes:
        table: where they stand in the paper.
        name: what they are of.
        results: results by method.
        unit: what performance is measured in.
        made: how they differ from ours.
    """

    table: str
    name: str
    results: dict[str, Figures]
    unit: str = "÷ SAC-N"
    made: str = "over SAC-N's on Brax v1"

    @property
    def key(self) -> str:
        """The table's name as part of a column's."""
        return self.table.lower().replace(" ", "_")

    @property
    def sized(self) -> bool:
        """Whether model sizes were published with them."""
        return any(figures.size for figures in self.results.values())


_KINDS = ("forgetting", "transfer", "robustness", "compositionality", "hard")
# Table 1, by domain; HalfCheetah and Ant are averages over their four scenarios.
_DOMAINS = {
    "halfcheetah": Source(
        "Table 1",
        "HalfCheetah (4 scenarios)",
        {
            "ft1": Figures(0.62, 0.29, 1.0),
            "ft_l2": Figures(0.38, 0.15, 2.0),
            "packnet": Figures(0.85, 0.14, 2.0),
            "ewc": Figures(0.43, 0.24, 3.0),
            "pnn": Figures(1.03, 0.14, 8.0),
            "sac_n": Figures(1.00, 0.15, 8.0),
            "ft_n": Figures(1.16, 0.20, 8.0),
            "csp": Figures(1.27, 0.27, 5.4),
            "rewire": Figures(1.17, 0.15, 2.1),
        },
    ),
    "ant": Source(
        "Table 1",
        "Ant (4 scenarios)",
        {
            "ft1": Figures(0.52, 0.26, 1.0),
            "ft_l2": Figures(0.78, 0.20, 2.0),
            "packnet": Figures(1.08, 0.21, 2.0),
            "ewc": Figures(0.55, 0.24, 3.0),
            "pnn": Figures(0.98, 0.31, 8.0),
            "sac_n": Figures(1.00, 0.38, 8.0),
            "ft_n": Figures(0.97, 0.20, 8.0),
            "csp": Figures(1.11, 0.17, 3.9),
            "rewire": Figures(1.22, 0.11, 2.1),
        },
    ),
    "humanoid": Source(
        "Table 1",
        "Humanoid",
        {
            "ft1": Figures(0.71, 0.07, 1.0),
            "ft_l2": Figures(0.68, 0.28, 2.0),
            "packnet": Figures(0.96, 0.21, 2.0),
            "ewc": Figures(0.94, 0.01, 3.0),
            "pnn": Figures(0.98, 0.26, 4.0),
            "sac_n": Figures(1.00, 0.29, 4.0),
            "ft_n": Figures(0.65, 0.46, 4.0),
            "csp": Figures(1.76, 0.19, 3.4),
            "rewire": Figures(1.78, 0.22, 2.0),
        },
    ),
}
ABLATION = {
    "ft_l2": Figures(0.67, 0.32),
    "rewire-without-caching-modes-alignment": Figures(0.76, 0.29),
    "rewire-without-modes-alignment": Figures(0.95, 0.24),
    "rewire-without-alignment": Figures(1.14, 0.22),
    "rewire-without-modes": Figures(1.15, 0.25),
    "rewire": Figures(1.31, 0.21),
}
"""Table 3, on halfcheetah/forgetting, from FT-L2 to all designs together."""


def _continual_world(name: str, results: dict[str, Figures]) -> Source:
    return Source(
        "Table 2",
        name,
        results,
        unit="success rate",
        made="success rates on Meta-World v1: the tasks of these names here are v3's, "
        "with other observations, rewards and rules of success. The authors' code "
        "reads success at the last step of an episode",
    )


_CW3 = _continual_world(
    "CW3, average of 8 triplets, Meta-World v1",
    {
        "ft1": Figures(0.29, 0.10),
        "ft_l2": Figures(0.22, 0.11),
        "packnet": Figures(0.49, 0.12),
        "ewc": Figures(0.32, 0.11),
        "pnn": Figures(0.56, 0.14),
        "sac_n": Figures(0.60, 0.14),
        "ft_n": Figures(0.65, 0.11),
        "csp": Figures(0.65, 0.08),
        "rewire": Figures(0.67, 0.09),
    },
)
_CW10 = _continual_world(
    "CW10, Meta-World v1",
    {
        "ft1": Figures(0.10, 0.01),
        "ft_l2": Figures(0.48, 0.05),
        "packnet": Figures(0.83, 0.02),
        "ewc": Figures(0.66, 0.03),
        "pnn": Figures(0.63, 0.07),
        "sac_n": Figures(0.73, 0.12),
        "ft_n": Figures(0.77, 0.09),
        "csp": Figures(0.81, 0.06),
        "rewire": Figures(0.84, 0.02),
    },
)
_SCENARIOS = {
    "halfcheetah/forgetting": Source(
        "Table 3",
        "this scenario",
        {method: ABLATION[method] for method in ("ft_l2", "rewire")},
    ),
    **{f"continual_world/t{number}": _CW3 for number in range(1, 9)},
    "continual_world/cw10": _CW10,
}


def sources(scenario: str, backend: str = "v1") -> tuple[Source, ...]:
    """What the paper has on a scenario of its own, and on its domain.

    On Brax, results of another backend than the paper's are told apart in `made`.
    """
    domain, _, kind = scenario.partition("/")
    whole = _DOMAINS.get(domain) if kind in _KINDS else None
    found = tuple(source for source in (whole, _SCENARIOS.get(scenario)) if source)
    if domain not in _DOMAINS or backend == "v1":
        return found
    return tuple(
        source._replace(made=f"{source.made}: the physics here is another")
        for source in found
    )
