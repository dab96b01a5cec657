"""Starts the workstation's server."""

from __future__ import annotations

from pathlib import Path


def serve(port: int = 0, case: Path | None = None, open_browser: bool = True, host_name: str = "127.0.0.1") -> None:
    """Serve the workstation until interrupted; loopback unless another interface is named."""
    from trame.app import get_server

    from Workstation.web.application import WorkstationApp

    server = get_server(client_type="vue3")
    WorkstationApp(server)
    server.start(port=port, host=host_name, open_browser=open_browser, show_connection_info=False, timeout=0)
