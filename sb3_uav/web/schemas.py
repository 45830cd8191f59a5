"""What requests may contain, with bounds on everything. ``strict``: true is no number and "1" neither."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints, ValidationError, model_validator

from sb3_uav.missions.flight import Firmware, Landing, Vehicle
from sb3_uav.web.limits import MOST_TASKS, MOST_UAVS

# As in sb3_uav.missions.checks, so that what can be read can be sent.
_UNSAFE = frozenset(("Cc", "Cs", "Zl", "Zp"))
_BIDI = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")


def _safe(text: str) -> str:
    check_text(text, "this")
    return text


#: Ids of tasks and UAVs.
Name = Annotated[str, StringConstraints(min_length=1, max_length=200), AfterValidator(_safe)]
Coordinate = Annotated[float, Field(ge=-1e9, le=1e9)]
Point = Annotated[list[Coordinate], Field(min_length=2, max_length=2)]
Meters = Annotated[float, Field(ge=0, le=1e9)]
Speed = Annotated[float, Field(gt=0, le=1e4)]
Percent = Annotated[float, Field(ge=0, lt=100)]


class Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, hide_input_in_errors=True)


class TaskIn(Strict):
    """A task."""

    id: Name
    point: Point = Field(description="[latitude, longitude] in degrees, or [x, y] in units of the plane")
    value: float = Field(default=1.0, ge=0, le=1e12)
    service_s: float = Field(default=0.0, ge=0, le=1e9, description="Seconds that a UAV stays there")
    must: bool = Field(default=False, description="Comes before all tasks that need not be served")
    altitude_m: float | None = Field(default=None, ge=-1_000, le=10_000, description="Meters above the depot")
    forbidden: bool = Field(default=False, description="Not to be served, whatever it is worth")


class TasksIn(Strict):
    """A list of tasks in the coordinates of the user."""

    system: Literal["wgs84", "plane"]
    meters_per_unit: float = Field(default=1.0, gt=0, le=1e9)
    depot: Point | None = None
    source: str = Field(default="tasks", max_length=300)
    tasks: list[TaskIn] = Field(max_length=MOST_TASKS)

    @model_validator(mode="after")
    def _check(self) -> TasksIn:
        check_text(self.source, "source")
        seen: set[str] = set()
        for number, task in enumerate(self.tasks, start=1):
            if task.id in seen:
                raise ValueError(f"task {number} has the id {task.id!r} of an earlier task; ids must differ")
            seen.add(task.id)
            self._check_point(task.point, f"task {number} ({task.id!r})")
        if self.depot is not None:
            self._check_point(self.depot, "the depot")
        return self

    def _check_point(self, point: list[float], where: str) -> None:
        if self.system == "wgs84" and not (-90 <= point[0] <= 90 and -180 <= point[1] <= 180):
            raise ValueError(
                f"{where} is at {point[0]:g}, {point[1]:g}; a latitude is from -90 to 90, a longitude from -180 to 180"
            )


class UavIn(Strict):
    """A UAV."""

    id: Name
    range_m: Meters
    speed_mps: Speed | None = None
    start: Point | None = Field(default=None, description="Where it is; at the depot when null")
    end: Point | None = Field(default=None, description="Where it lands; at the depot when null")
    reserve_percent: Percent = Field(default=0.0, description="Part of the range that no plan may use")


class FleetIn(Strict):
    """Either ``uavs``, or ``count`` equal ones."""

    count: int | None = Field(default=None, ge=1, le=MOST_UAVS)
    range_m: Annotated[float, Field(gt=0, le=1e9)] | None = None
    speed_mps: Speed | None = None
    reserve_percent: Percent = 0.0
    uavs: list[UavIn] | None = Field(default=None, min_length=1, max_length=MOST_UAVS)

    @model_validator(mode="after")
    def _check(self) -> FleetIn:
        if (self.uavs is None) == (self.count is None):
            raise ValueError("give either a list uavs, or count and range_m")
        if self.count is not None and self.range_m is None:
            raise ValueError("range_m is missing")
        ids = [uav.id for uav in self.uavs or ()]
        if len(set(ids)) < len(ids):
            raise ValueError("two UAVs have the same id; ids must differ")
        return self

    def to_uavs(self) -> list[dict[str, Any]]:
        """:return: The UAVs one by one, as of :class:`UavIn`"""
        if self.uavs is not None:
            return [uav.model_dump() for uav in self.uavs]
        assert self.count is not None and self.range_m is not None
        return [
            UavIn(
                id=f"uav-{number}", range_m=self.range_m, speed_mps=self.speed_mps, reserve_percent=self.reserve_percent
            ).model_dump()
            for number in range(1, self.count + 1)
        ]


class OptionsIn(Strict):
    """How to solve."""

    time_limit: float = Field(default=10.0, ge=0.1, le=86_400, description="Seconds")
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    solver: Literal["default", "local-search", "insertion"] = Field(
        default="default", description="default: the trained networks with repair and local search"
    )
    allow_duplicates: bool = Field(default=False, description="Whether tasks may lie at one point")


class SolveIn(Strict):
    """A problem to solve."""

    tasks: TasksIn
    fleet: FleetIn
    options: OptionsIn = OptionsIn()


class FlightIn(Strict):
    """How the mission is flown, for the files of the download. Of a query, where numbers are text."""

    model_config = ConfigDict(strict=False)

    altitude_m: float = Field(default=50.0, gt=0, le=10_000)
    altitude_step_m: float = Field(default=10.0, ge=0, le=1_000)
    firmware: Firmware = "px4"
    vehicle: Vehicle = "multirotor"
    landing: Landing = "rtl"


class Draft(Strict):
    """The work of one browser, kept by the server: the tasks, what the forms say, and the last solve."""

    tasks: TasksIn
    form: dict[Annotated[str, StringConstraints(max_length=40)], str | bool] = Field(default={}, max_length=40)
    uavs: list[UavIn] | None = Field(default=None, max_length=MOST_UAVS)
    solve: str | None = Field(default=None, max_length=64)

    @model_validator(mode="after")
    def _check(self) -> Draft:
        for name, value in self.form.items():
            if isinstance(value, str) and len(value) > 200:
                raise ValueError(f"{name} has more than 200 characters")
        return self


def check_text(text: str, what: str) -> None:
    """
    :param text: Text of the user
    :param what: What it is
    :raises ValueError: If it has characters that are written into no file
    """
    if any(unicodedata.category(char) in _UNSAFE or char in _BIDI for char in text):
        raise ValueError(f"{what} has control characters; leave them out")


def one_sentence(error: ValidationError) -> str:
    """
    :param error: What pydantic says
    :return: Where the first mistake is, and what is wrong there
    """
    return sentence_of(error.errors(include_url=False, include_context=False, include_input=False))


def sentence_of(found: Sequence[Any]) -> str:
    """
    :param found: Mistakes as pydantic lists them
    :return: Where the first one is, and what is wrong there
    """
    if not found:
        return "The request is wrong."
    place = ".".join(str(part)[:60] for part in found[0]["loc"] if part not in ("body", "query", "path"))
    text = str(found[0]["msg"]).removeprefix("Value error, ").rstrip(".")
    more = f" ({len(found) - 1} more)" if len(found) > 1 else ""
    return f"{place}: {text}{more}." if place else f"{text}{more}."
