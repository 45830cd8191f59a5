"""What the API answers, for its description."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field

from sb3_uav.web.schemas import Strict, TasksIn, UavIn


class Refusal(Strict):
    """What every error says."""

    detail: str = Field(description="One sentence")


class FileTasks(TasksIn):
    """The tasks of a file, its fleet if it has one, and what else the file says."""

    notes: list[str] = Field(default=[])
    uavs: list[UavIn] | None = None


class FileFleet(Strict):
    """The UAVs of a file."""

    system: Literal["wgs84", "plane"] | None = Field(
        description="Coordinates of their starts and ends, if the file says which"
    )
    uavs: list[UavIn]


class Progress(BaseModel):
    """Where a solve stands."""

    id: str
    state: Literal["waiting", "running", "done", "failed", "canceled"]
    place: int | None = Field(description="Solves before this one in the queue; null when it does not wait")
    error: str | None = Field(description="One sentence, when it failed or cannot start")
    version: int = Field(description="Grows with every change")
    elapsed_s: float
    time_limit: float
    has_plan: bool
    objective: float | None
    history: list[tuple[float, float]] = Field(description="Seconds and value of the plans so far")
    ready: bool = Field(description="False while the workers are being started")


class RouteOut(BaseModel):
    """What one UAV does."""

    uav: str
    stops: list[str] = Field(description="Ids of tasks in flying order")
    points: list[tuple[float, float]] = Field(description="Start, stops and end, as tasks have them")
    legs_m: list[float] = Field(description="Length of every leg, geodesic for latitudes and longitudes")
    length_m: float
    service_m: float = Field(description="Meters of range that serving the stops costs")
    used_m: float
    usable_m: float = Field(description="Range without the reserve")
    range_m: float
    share_of_range: float
    seconds: float | None = Field(description="Time in the air; null if the speed is not known")
    value: float


class SkippedOut(BaseModel):
    """A task that no UAV serves."""

    id: str
    reason: Literal["out of reach", "worth nothing", "did not fit", "forbidden"]
    missing_m: float | None = Field(description="Meters of range that the UAV lacks which is nearest to serving it")
    text: str


class Report(BaseModel):
    """Figures of a plan."""

    objective: float = Field(description="Value of the tasks that are served")
    total_value: float
    bound: float | None = Field(description="Proven upper bound of the objective; null without a proof")
    gap: float | None = Field(description="Part of the bound that may be missing; null without a bound")
    n_tasks: int
    n_served: int
    length_m: float
    unserved: list[str] = Field(description="Ids of tasks that must be served and are not")
    routes: list[RouteOut]
    skipped: list[SkippedOut]
    remarks: list[str]
    solver: str
    seed: int
    seconds: float


class PlanOut(BaseModel):
    """A plan."""

    mission: dict[str, Any] = Field(description="The content of mission.json")
    report: Report
