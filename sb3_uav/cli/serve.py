"""``sb3-uav serve``: the planner in a browser, and as a JSON API."""

from __future__ import annotations

import argparse
import ipaddress
import os
import socket
from collections.abc import Sequence
from urllib.parse import urlsplit

from sb3_uav.common.optional import require
from sb3_uav.web.limits import Limits

_DESCRIPTION = "Plan missions in a browser, and by a JSON API. Nothing leaves this machine, unless --tiles says so."
_SHORTEST_TOKEN = 16
_TOKEN_VARIABLE = "SB3_UAV_TOKEN"


def main(argv: Sequence[str] | None = None) -> int:
    """
    Serve until interrupted.

    :param argv: Command line arguments; those of the process when None
    :return: Exit code
    :raises ValueError: If an argument is wrong
    :raises OSError: If the address is in use
    :raises ImportError: If a package is missing
    """
    defaults = Limits()
    parser = argparse.ArgumentParser(
        prog="sb3-uav serve", description=_DESCRIPTION, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on; any other one needs a token")
    parser.add_argument("--port", type=int, default=8080, help="0 for any free one")
    parser.add_argument(
        "--token", default=None, help=f"what clients have to show, {_SHORTEST_TOKEN} characters or more; or {_TOKEN_VARIABLE}"
    )
    parser.add_argument("--allow-host", action="append", default=[], help="another name of this server; may be repeated")
    parser.add_argument("--tiles", default=None, help="URL of map tiles with {z}, {x}, {y}; none are loaded without it")
    parser.add_argument("--max-tasks", type=int, default=defaults.max_tasks, help="tasks of one problem")
    parser.add_argument("--max-body-mb", type=float, default=defaults.max_body_mb, help="size of one request")
    parser.add_argument("--max-solves", type=int, default=defaults.max_solves, help="solves at one time; others wait")
    parser.add_argument("--max-waiting", type=int, default=defaults.max_waiting, help="solves that may wait")
    parser.add_argument("--time-limit", type=float, default=defaults.max_seconds, help="longest solve in seconds")
    args = parser.parse_args(argv)

    limits = Limits(
        max_tasks=args.max_tasks,
        max_body_mb=args.max_body_mb,
        max_solves=args.max_solves,
        max_waiting=args.max_waiting,
        max_seconds=args.time_limit,
    )
    token = _checked_token(args.token or os.environ.get(_TOKEN_VARIABLE), args.host)
    tiles = None if args.tiles is None else _checked_tiles(args.tiles)
    if not 0 <= args.port <= 65_535:
        raise ValueError(f"--port is {args.port}; give a number from 0 to 65535.")
    uvicorn = require("uvicorn", "sb3-uav serve", "web")
    require("fastapi", "sb3-uav serve", "web")
    from sb3_uav.web.app import Settings, create_app

    names = {*args.allow_host, *([] if _is_loopback(args.host) else [socket.gethostname(), socket.getfqdn()])}
    if not _is_address(args.host):
        names.add(args.host)
    # Bound before anything is started, so that a port in use ends in one line.
    with _listen(args.host, args.port) as listener:
        port = listener.getsockname()[1]
        app = create_app(Settings(limits, token, tuple(names), port, tiles))
        shown = f"[{args.host}]" if ":" in args.host else args.host
        print(f"sb3-uav serve: http://{shown}:{port} (Ctrl-C ends it)", flush=True)
        config = uvicorn.Config(
            app,
            # It bounds what headers may take; httptools, which uvicorn prefers where it is installed, does not.
            http="h11",
            log_level="warning",
            access_log=False,
            server_header=False,
            ws="none",
            proxy_headers=False,
            limit_concurrency=256,
            timeout_keep_alive=15,
            timeout_graceful_shutdown=3,
        )
        uvicorn.Server(config).run(sockets=[listener])
    return 0


def _is_loopback(host: str) -> bool:
    return host == "localhost" or (_is_address(host) and ipaddress.ip_address(host).is_loopback)


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _checked_token(token: str | None, host: str) -> str | None:
    if token is None and not _is_loopback(host):
        raise ValueError(f"--host is {host}, which others can reach; give a --token, or set {_TOKEN_VARIABLE}.")
    if token is not None and (len(token) < _SHORTEST_TOKEN or not token.isascii() or not token.isprintable() or " " in token):
        raise ValueError(f"--token must have {_SHORTEST_TOKEN} printable ASCII characters or more, and no spaces.")
    return token


def _checked_tiles(tiles: str) -> str:
    parts = urlsplit(tiles)
    missing = [key for key in ("{z}", "{x}", "{y}") if key not in tiles]
    if parts.scheme not in ("http", "https") or not parts.netloc or missing or any(char in parts.netloc for char in " ;,'\""):
        raise ValueError(f"--tiles is {tiles!r}; give a URL such as https://tiles.example.org/{{z}}/{{x}}/{{y}}.png.")
    return tiles


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(128)
    except OSError as error:
        listener.close()
        raise OSError(f"{host}:{port}: cannot listen there ({error.strerror}); choose another --port.") from error
    return listener
