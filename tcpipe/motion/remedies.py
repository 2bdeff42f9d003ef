"""The largest losses of drives, and what wins the metres back, by the entry of the ledger that has them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from tcpipe.recipe.suggestions import RecipeFragment, recipe_key
from tcpipe.tables.bits import DropReason, Loss, name_of

_SPEED = recipe_key("gate.max_velocity_mps")
_KEEP_SLOWER = RecipeFragment({"gate": {"require_full_speed": False}}).inline()
_PLACE, _STD = recipe_key("read.placement"), recipe_key("sample.max_position_std_m")

REMEDIES: Mapping[str, str] = {
    name_of(reason): text
    for reason, text in {
        DropReason.GAP: "a sensor is silent or positions too uncertain: the run's warnings and 'tcpipe inspect --full' say which and when",
        DropReason.STANDING: "nothing: standing tells the standing power, and costs time only",
        DropReason.STUCK: "nothing: wheels that spin in place tell no metre's cost; mind such ground when planning",
        DropReason.TURNING_IN_PLACE: "drive wide turns instead of turning on the spot, and longer legs between them",
        DropReason.REVERSING: "drive forwards",
        DropReason.ACCELERATING: "hold one speed over long legs: each start, stop and commanded change costs two seconds",
        DropReason.BELOW_LIMIT: f"command full speed; if that was its limit, state it ({_SPEED}); to keep slower driving: {_KEEP_SLOWER}",
        Loss.CURVED: "drive straighter lines: a metre whose arc is 2 % longer than its chord is no segment",
        Loss.LEFTOVER: "drive longer steady legs: each ends with up to a metre that is no whole segment",
        Loss.OUTSIDE_MAP: "a map that reaches two metres beyond what is driven",
        Loss.NODATA: f"a map without holes there, or accept some ({recipe_key('sample.min_valid_fraction')})",
        Loss.NOT_TRAVERSABLE: "look at the terrain raster and its class table: the robot drove where they say it cannot",
        Loss.POSITION_UNCERTAIN: f"RTK corrections and the antenna's place ({_PLACE}); or accept more ({_STD})",
        Loss.SPLIT_BUFFER: "fewer and larger regions: what lies near their borders goes to no split",
        Loss.NO_POWER: "record the power topic over the whole drive",
        Loss.SPLIT_EXCLUDED: "nothing: a region says so",
        Loss.RECORDED_TWICE: "nothing: another run holds the same drive",
    }.items()
}  # fmt: skip
"""By entry, in words."""

_MOST_LOSSES = 10
_WORTH_M = 0.05


@dataclass(frozen=True, slots=True)
class StoreLoss:
    """Metres that are in no segment for one reason, and what would win them back."""

    reason: str
    metres: float
    share: float
    """Of all metres driven [1]."""
    runs: int
    """Runs that lost metres so."""
    remedy: str

    def __str__(self) -> str:
        """Return the loss as one line."""
        many = "1 run" if self.runs == 1 else f"{self.runs} runs"
        return f"{self.metres:>9.1f} m ({self.share:.1%}) {self.reason.replace('_', ' ')} in {many}: {self.remedy}"


def losses_of(ledgers_m: Iterable[Mapping[str, float]]) -> tuple[StoreLoss, ...]:
    """Return the ten largest losses of runs, by their ledgers [m], the largest first."""
    metres, of_runs = Counter[str](), Counter[str]()
    for ledger_m in ledgers_m:
        metres.update(ledger_m)
        of_runs.update(reason for reason, lost_m in ledger_m.items() if lost_m >= _WORTH_M)
    total = sum(metres.values())
    lost = [(reason, lost_m) for reason, lost_m in metres.most_common() if reason != "kept" and of_runs[reason]]
    return tuple(
        StoreLoss(reason, lost_m, lost_m / total, of_runs[reason], REMEDIES.get(reason, ""))
        for reason, lost_m in lost[:_MOST_LOSSES]
    )
