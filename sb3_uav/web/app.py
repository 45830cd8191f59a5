"""The app: page, sessions, login and API behind the gate."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlsplit

import anyio
from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse
from fastapi.staticfiles import StaticFiles
from pydantic import Field, ValidationError

import sb3_uav
from sb3_uav.web.answers import Refusal
from sb3_uav.web.api import Rooms, api_router
from sb3_uav.web.guard import Guard, Keys, cookie_of
from sb3_uav.web.limits import Limits
from sb3_uav.web.schemas import Draft, Strict, sentence_of
from sb3_uav.web.sessions import Sessions

STATIC = Path(__file__).parent / "static"
_DESCRIPTION = """Plan missions of UAVs: send tasks and a fleet, watch the plan improve, download the files.

Every error is `{"detail": "one sentence"}` with a status from 400 to 499."""


@dataclass(frozen=True)
class Settings:
    """
    :param limits: What is admitted
    :param token: What clients have to show; None if everybody on this machine may ask
    :param names: Names of this server beside ``localhost``
    :param port: Port of the server
    :param tiles: URL of map tiles with ``{z}``, ``{x}``, ``{y}``; None without
    """

    limits: Limits = field(default_factory=Limits)
    token: str | None = None
    names: tuple[str, ...] = ()
    port: int = 8080
    tiles: str | None = None

    @property
    def tiles_origin(self) -> str | None:
        """Where tiles come from, as the browser's policy names it."""
        if self.tiles is None:
            return None
        parts = urlsplit(self.tiles)
        host = parts.netloc.replace("{s}", "*")
        return f"{parts.scheme}://{host}"


class Login(Strict):
    token: Annotated[str, Field(max_length=500)]


def create_app(settings: Settings | None = None) -> Any:
    """
    :param settings: Settings
    :return: An ASGI app. Its processes start with its lifespan and end with it; ``rooms`` of its state has them
    """
    settings = settings or Settings()
    keys, sessions = Keys(settings.token, settings.port), Sessions(settings.limits.max_sessions)
    rooms = Rooms(settings.limits, settings.tiles)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        rooms.open()
        try:
            yield
        finally:
            await anyio.to_thread.run_sync(rooms.close)

    # Not FastAPI's pages of documentation: they load scripts from elsewhere.
    app = FastAPI(
        title="sb3-uav serve",
        version=sb3_uav.__version__,
        description=_DESCRIPTION,
        docs_url=None,
        redoc_url=None,
        openapi_url="/api/v1/openapi.json",
        lifespan=lifespan,
    )
    app.state.rooms, app.state.sessions = rooms, sessions
    app.include_router(api_router(rooms))
    _add_page(app, keys, sessions, settings.limits.max_tasks)
    _add_errors(app)
    _name_errors(app)
    return Guarded(
        app,
        Guard(
            app,
            keys,
            {"localhost", *settings.names},
            settings.limits.max_body_bytes,
            settings.limits.max_bodies,
            settings.tiles_origin,
        ),
    )


class Guarded:
    """
    An app behind its gate.

    :param app: The app
    :param guard: The gate
    """

    def __init__(self, app: FastAPI, guard: Guard) -> None:
        self.app, self.state, self._guard = app, app.state, guard

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        await self._guard(scope, receive, send)


def _add_page(app: FastAPI, keys: Keys, sessions: Sessions, max_tasks: int) -> None:
    failures = asyncio.Semaphore(2)

    @app.get("/", include_in_schema=False)
    def page() -> Response:
        return FileResponse(STATIC / "index.html", headers={"cache-control": "no-store"})

    @app.get("/login", include_in_schema=False)
    def login_page() -> Response:
        return FileResponse(STATIC / "login.html", headers={"cache-control": "no-store"})

    @app.post("/login", include_in_schema=False)
    async def login(given: Login, response: Response) -> dict[str, bool]:
        if not keys.is_open and not keys.fits(given.token):
            # Two guesses a second at most, from all clients together.
            async with failures:
                await asyncio.sleep(1.0)
            raise HTTPException(403, "This is not the token.")
        response.set_cookie(keys.login_cookie, keys.login_value, httponly=True, samesite="strict")
        return {"ok": True}

    def session_of(request: Request) -> str:
        return cookie_of({"cookie": request.headers.get("cookie", "")}, keys.session_cookie)

    @app.get("/session", include_in_schema=False)
    def load(request: Request) -> Response:
        return Response(sessions.load(session_of(request)) or b"null", media_type="application/json")

    @app.put("/session", include_in_schema=False)
    def save(draft: Draft, request: Request, response: Response) -> dict[str, bool]:
        # What cannot be solved is not kept either: sessions stay in memory.
        if len(draft.tasks.tasks) > max_tasks:
            raise HTTPException(422, f"This server admits {max_tasks} tasks at most.")
        given = session_of(request)
        name = sessions.save(given, draft.model_dump_json().encode())
        if name != given:
            response.set_cookie(keys.session_cookie, name, httponly=True, samesite="strict", max_age=30 * 86_400)
        return {"ok": True}

    app.mount("/static", StaticFiles(directory=STATIC), name="static")


def _add_errors(app: FastAPI) -> None:
    @app.exception_handler(RequestValidationError)
    @app.exception_handler(ValidationError)
    async def wrong(_: Request, error: RequestValidationError | ValidationError) -> JSONResponse:
        return JSONResponse({"detail": sentence_of(error.errors())}, 422)

    @app.exception_handler(Exception)
    async def broken(_: Request, error: Exception) -> JSONResponse:
        logging.getLogger("uvicorn.error").error("%s", type(error).__name__, exc_info=error)
        return JSONResponse({"detail": "This is a fault of the program, not of your input."}, 500)


def _name_errors(app: FastAPI) -> None:
    """Say in OpenAPI how errors look."""
    plain = app.openapi

    def openapi() -> dict[str, Any]:
        schema = plain()
        schema["components"]["schemas"]["Refusal"] = Refusal.model_json_schema()
        return schema

    app.openapi = openapi  # type: ignore[method-assign]
