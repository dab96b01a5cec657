"""`cranionav emulate polaris`: a stand-in for an NDI Polaris on a pseudo-terminal or a TCP port."""

from __future__ import annotations

from pathlib import Path


def run(
    replay: Path | None = None,
    faults: list[str] | None = None,
    tcp: bool = False,
    *,
    port: int = 0,
    patient: bool = False,
    rate_hz: float = 60.0,
    seed: int = 0,
    link: Path | None = None,
    keep_state: bool = False,
    paced: bool = False,
    text_only: bool = False,
) -> None:
    """Print the port as the first line, then serve it until interrupted.

    Parameters
    ----------
    replay : Path, optional
        Pose CSV, played in a loop; without it four tools move as if by hand at `rate_hz`.
    faults : list of str
        `NAME`, `NAME=NUMBER` or `NAME=NUMBER:NUMBER`, see `ModuleTrackingLib.ndi.emulator.faults.FAULTS`. While it runs, lines on
        standard input change them: `fault NAME`, `clear`, `reset`, `unplug SECONDS`; SIGUSR1 resets too.
    tcp, port : bool, int
        Serve 127.0.0.1 instead of a pseudo-terminal; port 0 takes a free one.
    patient : bool
        Without a pose CSV: the tools of a simulated session on the virtual patient (the sample head).
    link : Path, optional
        A symbolic link with a name of its own that points to the pseudo-terminal.
    keep_state : bool
        Closing the port does not reset the device.
    paced : bool
        Replies take the time that they need at the line's speed.
    text_only : bool
        A device without BX.

    Raises
    ------
    InputError
        A pose file or a fault that cannot be used, or no pseudo-terminals on this system.
    """
    from ModuleTrackingLib.ndi.emulator.device import EmulatedPolaris, Model
    from ModuleTrackingLib.ndi.emulator.motion import HandMotion, Motion, ReplayedMotion
    from ModuleTrackingLib.ndi.emulator.server import open_line, serve
    from ModuleTrackingLib.ndi.emulator.station import Station, make_faults

    found = make_faults(faults or [], seed)
    motion: Motion = ReplayedMotion(replay) if replay is not None else HandMotion(rate_hz)
    if patient and replay is None:
        from ModuleTrackingLib.ndi.emulator.patient import patient_motion

        motion = patient_motion(seed, rate_hz)
    device = EmulatedPolaris(motion, found, Model(has_bx=not text_only))
    line = open_line(tcp, port, link)
    try:
        print(line.url, flush=True)
        serve(Station(device, paced), line, keep_state)
    finally:
        line.close()
