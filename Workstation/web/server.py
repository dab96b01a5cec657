"""Starts the workstation's server, and lets only those in who may."""

from __future__ import annotations

import os
import secrets
import sys
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from CranioNavLib.errors import InputError

LOOPBACK = ("127.0.0.1", "localhost", "::1")
COOKIE = "cranionav-token"


def serve(
    port: int = 0,
    case: Path | None = None,
    open_browser: bool = True,
    host_name: str = "127.0.0.1",
    data: Path | None = None,
) -> None:
    """Serve the workstation until interrupted; loopback unless another interface is named, which then asks for a token."""
    os.environ.setdefault("WSLINK_READY_MSG", "")  # the first line on stdout is the address
    os.environ.setdefault("WSLINK_WS_COMPRESS", "0")  # pictures are compressed already
    os.environ.setdefault("TRAME_WS_HEART_BEAT", "10")  # seconds; a dropped connection is noticed in half as much more
    from trame.app import get_server

    token = "" if host_name in LOOPBACK else secrets.token_urlsafe(16)
    server = get_server(client_type="vue3")
    _silence_vtk()
    from Workstation.web.application import WorkstationApp
    from Workstation.web.pictures import PICTURES
    from Workstation.web.session_link import ALIVE

    application = WorkstationApp(server, case, data, confined=bool(token))

    def bound(web: Any) -> None:
        web.app.middlewares.append(_gate(token))
        web.app.router.add_get("/session/{name}", _file_of(application))
        web.app.router.add_post("/paraview/", _tell_socket)
        web.app.router.add_get(f"/{ALIVE}", _alive_of(application.windows))
        web.app.router.add_post("/upload", _upload_of(application))
        web.app.router.add_get(f"/{PICTURES}", application.pictures.serve)
        application.windows.guard(web)

    def ready(**_: Any) -> None:
        url = f"http://{host_name}:{server.port}/" + (f"?token={token}" if token else "")
        print(url, flush=True)
        if open_browser:
            import webbrowser

            webbrowser.open(url)
        if case is not None and _holds_case(case):
            application.open_case()

    server.controller.on_server_bind.add(bound)
    server.controller.on_server_ready.add(ready)
    server.start(port=port, host=host_name, open_browser=False, show_connection_info=False, timeout=0)


def _holds_case(folder: Path) -> bool:
    """A case to load; one with a session is offered to go on instead."""
    from Workstation.web.session_folder import STATE_FILE

    return (folder / "landmarks-ct.mrk.json").is_file() and not (folder / STATE_FILE).is_file()


def _silence_vtk() -> None:
    """VTK speaks on stderr of displays that are not there; its errors reach the log of the logics that cause them."""
    from vtkmodules.vtkCommonCore import vtkLogger, vtkObject, vtkOutputWindow, vtkStringOutputWindow

    vtkObject.GlobalWarningDisplayOff()
    vtkOutputWindow.SetInstance(vtkStringOutputWindow())
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)


def _gate(token: str) -> Any:
    """Refuses sockets opened by other pages, and whoever lacks the token if there is one."""
    from aiohttp import web

    @web.middleware
    async def gate(request: Any, handler: Any) -> Any:
        origin = request.headers.get("Origin")
        if origin and urlsplit(origin).netloc != request.host:
            return web.Response(status=403, text="this address is not the workstation's own")
        if not token:
            if urlsplit(f"//{request.host}").hostname not in LOOPBACK:  # another name that leads here (DNS rebinding)
                return web.Response(status=403, text="call the workstation by its loopback address")
            return await handler(request)
        given = request.query.get("token", "")
        if not secrets.compare_digest(given or request.cookies.get(COOKIE, ""), token):
            return web.Response(status=403, text="open the address that the workstation printed, with its token")
        response = await handler(request)
        if given and not response.prepared:
            response.set_cookie(COOKIE, token, httponly=True, samesite="Strict")
        return response

    return gate


async def _tell_socket(request: Any) -> Any:
    """Answers trame's page, which asks a launcher for its websocket before it takes this server's: unanswered, every start
    would leave an error in the browser's console."""
    from aiohttp import web

    scheme = "wss" if request.scheme == "https" else "ws"
    return web.json_response({"sessionURL": f"{scheme}://USE_HOST/ws"})


def _alive_of(windows: Any) -> Any:
    """Answers a page that asks whether the server is there, whether it is still the same, and whether it knows the page."""
    from aiohttp import web

    async def answer(request: Any) -> Any:
        return web.json_response({"boot": windows.boot, "open": windows.is_open(request.query.get("window", ""))})

    return answer


def _upload_of(application: Any) -> Any:
    """Takes a CT that the controlling window sends, into the session's folder."""
    from aiohttp import web

    async def take(request: Any) -> Any:
        query = request.query
        if not application.windows.holds_control(query.get("window", "")):
            return web.Response(status=403, text="this window only watches; take control first")
        try:
            path = await application.places.receive(
                query.get("folder", ""), query.get("name", ""), request.content.iter_chunked(2**18)
            )
        except InputError as error:
            return web.Response(status=400, text=application.places.shown(str(error)))
        except OSError as error:
            return web.Response(status=400, text=f"it cannot be kept: {error.strerror}")
        return web.Response(text=path)

    return take


def _file_of(application: Any) -> Any:
    """Serves what the session offers, and nothing else of its folder."""
    from aiohttp import web

    async def serve_file(request: Any) -> Any:
        from Workstation.web.procedure import SESSION

        name = request.match_info["name"]
        if name not in application.logics[SESSION].offered():
            return web.Response(status=404, text="the session has no such file yet")
        return web.FileResponse(application.session.folder / name)

    return serve_file


if __name__ == "__main__":
    serve(int(sys.argv[1]) if len(sys.argv) > 1 else 0, open_browser=False)
