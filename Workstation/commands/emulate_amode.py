"""`cranionav emulate amode`: a stand-in for an A-mode pulser/receiver."""

from __future__ import annotations

from pathlib import Path


def run(
    replay: Path | None = None,
    faults: list[str] | None = None,
    protocol: str = "serial",
    port: int = 0,
    pty: bool = False,
    rate_hz: float = 20.0,
    seed: int = 0,
) -> None:
    """Serve the device until interrupted; its port is the first line on stdout.

    Parameters
    ----------
    replay : Path, optional
        Lines of an .igs.mha recording; None: of the virtual patient.
    faults : list of str, optional
        Names of what goes wrong on the line, each with "=rate" if its usual rate will not do.
    protocol : str
        "serial" or "pic0rick".
    port : int
        TCP port on loopback; 0: any free one.
    pty : bool
        A pseudo terminal instead of a TCP port.
    rate_hz : float
        Lines a second ("serial").
    seed : int
        Of faults and virtual patient.

    Raises
    ------
    InputError
        An unknown protocol or fault, or a recording that cannot be played.
    """
    from ModuleUltrasoundLib.emulators.__main__ import emulate

    emulate(protocol, replay, faults or [], port, pty, rate_hz, seed)
