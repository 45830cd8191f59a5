"""The JSON API."""

from __future__ import annotations

import json
import zlib
from dataclasses import asdict
from typing import Annotated, Any

import anyio
from fastapi import APIRouter, HTTPException, Path, Query, Request, Response

import sb3_uav
from sb3_uav.web.answers import FileFleet, FileTasks, PlanOut, Progress
from sb3_uav.web.jobs import PARTS, BusyError, Job, Pool
from sb3_uav.web.limits import MOST_UAVS, Limits
from sb3_uav.web.schemas import FleetIn, FlightIn, OptionsIn, SolveIn, TasksIn, check_text

SOLVERS = {"default": None, "local-search": "local-search", "insertion": "greedy-insertion"}
# A solve may take this much longer than its time limit: the networks look at no clock.
_GRACE_SECONDS = 60.0

SolveId = Annotated[str, Path(max_length=64, description="Id of a solve")]
FileName = Annotated[str, Query(max_length=200, description="Name of the file; its suffix tells the format")]
Unit = Annotated[str | None, Query(max_length=20, description="Unit of x and y, where the file does not say")]
_RAW = {"requestBody": {"required": True, "content": {"application/octet-stream": {"schema": {"format": "binary"}}}}}
_ERRORS: dict[int | str, dict[str, Any]] = {
    status: {"description": text, "content": {"application/json": {"schema": {"$ref": "#/components/schemas/Refusal"}}}}
    for status, text in {
        404: "There is no such solve, or it has no plan yet",
        413: "The body is too large",
        422: "The input is wrong",
        429: "Too many solves wait",
    }.items()
}


class Rooms:
    """
    What the API works with.

    :param limits: What is admitted
    :param tiles: URL of map tiles
    """

    def __init__(self, limits: Limits, tiles: str | None = None) -> None:
        self.limits, self.tiles = limits, tiles
        self.solves = Pool(limits.max_solves, limits.max_waiting, limits.max_kept, "solves")
        # Files are read and written apart from solves, so that neither waits for the other; a large zip takes seconds.
        self.desk = Pool(2, 16, 2, "files")

    def open(self) -> None:
        """Start the processes."""
        self.solves.open()
        self.desk.open()

    def close(self) -> None:
        """End all processes."""
        self.solves.close()
        self.desk.close()

    def progress(self, job: Job) -> Progress:
        """:return: Where a solve stands"""
        return Progress(
            id=job.id,
            state=job.state,
            place=self.solves.place(job),
            # What keeps the workers from starting, where that is why it waits.
            error=self.solves.start_error if job.state == "waiting" else job.error,
            version=job.version,
            elapsed_s=round(job.elapsed, 2),
            time_limit=job.about["time_limit"],
            has_plan=bool(job.parts),
            objective=job.message.get("objective"),
            history=list(job.history),
            ready=self.solves.is_ready,
        )

    def find(self, name: str) -> Job:
        """
        :param name: Id of a solve
        :return: The solve
        :raises HTTPException: If there is none
        """
        job = self.solves.get(name)
        if job is None:
            raise HTTPException(404, "There is no such solve; old ones are dropped.")
        return job

    def part(self, name: str, part: str) -> bytes:
        """
        :param name: Id of a solve
        :param part: One of :data:`~sb3_uav.web.jobs.PARTS`
        :return: JSON of its best plan so far
        :raises HTTPException: If there is none
        """
        parts = self.find(name).parts
        if not parts:
            raise HTTPException(404, "This solve has no plan yet.")
        return zlib.decompress(parts[PARTS.index(part)])

    async def at_desk(self, request: dict[str, Any], blocks: list[bytes]) -> bytes:
        """
        :param request: A request to read or to write
        :param blocks: What goes with it
        :return: The result
        :raises HTTPException: If it fails
        """
        job = Job(request, blocks, self.limits.desk_seconds)
        try:
            self.desk.submit(job)
        except BusyError as error:
            raise HTTPException(429, str(error)) from error
        try:
            await anyio.to_thread.run_sync(job.over.wait, self.limits.desk_seconds * 3 + 120, abandon_on_cancel=True)
        finally:
            # Nobody asks for the result of a job that was given up.
            if not job.over.is_set():
                self.desk.cancel(job)
        if job.state != "done":
            raise HTTPException(422, job.error or "This took too long and was stopped.")
        return job.parts[0]

    async def read_tasks(self, name: str, data: bytes, unit: str | None, allow_duplicates: bool) -> bytes:
        """:return: The tasks of a file, as of :class:`FileTasks`"""
        return await self._read("tasks", name, data, {"unit": unit, "allow_duplicates": allow_duplicates})

    async def read_fleet(self, name: str, data: bytes) -> bytes:
        """:return: The UAVs of a file"""
        return await self._read("fleet", name, data, {})

    async def _read(self, what: str, name: str, data: bytes, options: dict[str, Any]) -> bytes:
        try:
            check_text(name, "name")
        except ValueError as error:
            raise HTTPException(422, f"{error}.") from error
        if not data:
            raise HTTPException(422, f"{name}: the file is empty.")
        limits = self.limits
        about = {"kind": "read", "what": what, "max_tasks": limits.max_tasks, "max_uavs": limits.max_uavs}
        # Only the last part, as browsers of old sent whole paths; it is used in sentences and for its suffix.
        short = name.replace("\\", "/").rpartition("/")[2] or "file"
        return await self.at_desk({**about, "name": short, **options}, [data])

    def start(self, given: SolveIn) -> Progress:
        """
        :param given: A problem
        :return: The solve that was started
        :raises HTTPException: If it is wrong or too large, or too many solves wait
        """
        limits, options = self.limits, given.options
        wanted = [task for task in given.tasks.tasks if not task.forbidden]
        uavs = given.fleet.to_uavs()
        first_timed = next((task for task in wanted if task.service_s > 0), None)
        slow = next((uav["id"] for uav in uavs if uav["speed_mps"] is None), None)
        for is_wrong, sentence in (
            (not given.tasks.tasks, "There are no tasks."),
            (not wanted, "All tasks are forbidden."),
            (len(given.tasks.tasks) > limits.max_tasks, f"This server admits {limits.max_tasks} tasks at most."),
            (len(uavs) > limits.max_uavs, f"This server admits {limits.max_uavs} UAVs at most."),
            (options.time_limit > limits.max_seconds, f"This server solves for {limits.max_seconds:g} s at most."),
            (given.tasks.depot is None, "There is no depot; say where the UAVs start and land."),
            (
                first_timed and slow,
                f"Task {first_timed and first_timed.id!r} takes time, but UAV {slow!r} has no speed; give it one.",
            ),
        ):
            if is_wrong:
                raise HTTPException(422, sentence)
        problem = {
            "tasks": given.tasks.model_dump(),
            "uavs": uavs,
            **options.model_dump(),
            "solver": SOLVERS[options.solver],
        }
        job = Job(
            {"kind": "solve"},
            [json.dumps(problem, allow_nan=False).encode()],
            options.time_limit + _GRACE_SECONDS,
            {"time_limit": options.time_limit},
        )
        try:
            return self.progress(self.solves.submit(job))
        except BusyError as error:
            raise HTTPException(429, str(error)) from error


def api_router(rooms: Rooms) -> APIRouter:
    """
    :param rooms: What the API works with
    :return: All routes below ``/api/v1``
    """
    api = APIRouter(prefix="/api/v1", responses=_ERRORS)

    @api.get("/limits")
    def limits() -> dict[str, Any]:
        """What this server admits, and whether its workers are ready."""
        found = {**asdict(rooms.limits), "version": sb3_uav.__version__, "tiles": rooms.tiles}
        return {**found, "ready": rooms.solves.is_ready, "error": rooms.solves.start_error}

    @api.post("/tasks", response_model=FileTasks, openapi_extra=_RAW)
    async def read_tasks(request: Request, name: FileName, unit: Unit = None, allow_duplicates: bool = False) -> Response:
        """Read a file of tasks: CSV, GeoJSON, QGroundControl plan, WPL, Chao, OPLib, npz, or a mission.json of ours."""
        return _json(await rooms.read_tasks(name, await request.body(), unit, allow_duplicates))

    @api.post("/fleets", response_model=FileFleet, openapi_extra=_RAW)
    async def read_fleet(request: Request, name: FileName) -> Response:
        """Read a CSV of UAVs."""
        return _json(await rooms.read_fleet(name, await request.body()))

    @api.post("/solves", status_code=202)
    def solve(given: SolveIn) -> Progress:
        """Start a solve, or put it into the queue."""
        return rooms.start(given)

    @api.post("/solves/from-file", status_code=202, openapi_extra=_RAW)
    async def solve_file(
        request: Request,
        name: FileName,
        count: Annotated[int, Query(ge=1, le=MOST_UAVS, description="Number of equal UAVs")],
        range_m: Annotated[float, Query(gt=0, le=1e8, allow_inf_nan=False)],
        speed_mps: Annotated[float | None, Query(gt=0, le=1000, allow_inf_nan=False)] = None,
        reserve_percent: Annotated[float, Query(ge=0, lt=100, allow_inf_nan=False)] = 0.0,
        depot: Annotated[str | None, Query(max_length=80, description="LAT,LON or X,Y, where the file has none")] = None,
        time_limit: Annotated[float, Query(ge=0.1, le=86_400, allow_inf_nan=False)] = 10.0,
        seed: Annotated[int, Query(ge=0, le=2**31 - 1)] = 0,
        unit: Unit = None,
        allow_duplicates: bool = False,
    ) -> Progress:
        """Read a file of tasks and start a solve for a fleet of equal UAVs."""
        read = FileTasks.model_validate_json(await rooms.read_tasks(name, await request.body(), unit, allow_duplicates))
        tasks = TasksIn(**read.model_dump(exclude={"uavs", "notes"}))
        if depot is not None:
            tasks = TasksIn(**{**tasks.model_dump(), "depot": _numbers(depot)})
        fleet = FleetIn(count=count, range_m=range_m, speed_mps=speed_mps, reserve_percent=reserve_percent)
        options = OptionsIn(time_limit=time_limit, seed=seed, allow_duplicates=allow_duplicates)
        return rooms.start(SolveIn(tasks=tasks, fleet=fleet, options=options))

    @api.get("/solves/{name}")
    def progress(name: SolveId) -> Progress:
        """Where a solve stands."""
        return rooms.progress(rooms.find(name))

    @api.get("/solves/{name}/plan", response_model=PlanOut)
    def plan(name: SolveId) -> Response:
        """The best plan so far: ``mission`` as in mission.json, and ``report`` with lengths and reasons."""
        return _json(b'{"mission": ' + rooms.part(name, "mission") + b', "report": ' + rooms.part(name, "report") + b"}")

    @api.get("/solves/{name}/routes.geojson")
    def geojson(name: SolveId) -> Response:
        """The best plan so far as GeoJSON."""
        return Response(rooms.part(name, "geojson"), media_type="application/geo+json")

    @api.get("/solves/{name}/download")
    async def download(name: SolveId, flight: Annotated[FlightIn, Query()]) -> Response:
        """All files of the best plan so far, as a zip."""
        rooms.part(name, "mission")
        packed = rooms.find(name).parts[PARTS.index("mission")]
        data = await rooms.at_desk({"kind": "write", "flight": flight.model_dump()}, [packed])
        return Response(
            data, media_type="application/zip", headers={"content-disposition": 'attachment; filename="mission.zip"'}
        )

    @api.delete("/solves/{name}")
    def cancel(name: SolveId) -> Progress:
        """Cancel a solve. The plan that it has found is kept."""
        job = rooms.find(name)
        rooms.solves.cancel(job)
        job.over.wait(5.0)
        return rooms.progress(job)

    return api


def _json(data: bytes) -> Response:
    return Response(data, media_type="application/json")


def _numbers(text: str) -> list[float]:
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError as error:
        raise HTTPException(422, f"depot is {text!r}; give two numbers with a comma between.") from error
    return [first, second]
