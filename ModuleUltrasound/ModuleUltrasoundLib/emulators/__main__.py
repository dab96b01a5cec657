"""`python -m ModuleUltrasoundLib.emulators [--protocol serial|pic0rick] [--replay FILE] [--fault NAME ...]`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Optional

from CranioNavLib.errors import InputError

from ModuleUltrasoundLib.emulators.amode_serial import SerialPulser
from ModuleUltrasoundLib.emulators.faults import DEFAULT_RATES, Faults
from ModuleUltrasoundLib.emulators.line_source import RawCodes, open_source
from ModuleUltrasoundLib.emulators.pic0rick_shell import Pic0rickShell
from ModuleUltrasoundLib.emulators.server import Door, EmulatedDevice, PtyDoor, TcpDoor, run_until_interrupted

PROTOCOLS = ("serial", "pic0rick")


def emulate(
    protocol: str = "serial",
    replay: Optional[Path] = None,
    faults: Sequence[str] = (),
    port: int = 0,
    pty: bool = False,
    rate_hz: float = 20.0,
    seed: int = 0,
) -> None:
    """Serve an emulated A-mode device until interrupted; the first line on stdout is its port.

    Parameters
    ----------
    protocol : str
        "serial" (the framed protocol) or "pic0rick" (its shell firmware).
    replay : Path, optional
        Lines of an .igs.mha recording, or converter codes (.npz); else the virtual patient's.
    faults : sequence of str
        Names of `emulators.faults`, each with "=rate" if its own rate will not do.
    port : int
        TCP port on loopback; 0: any free one.
    pty : bool
        A pseudo terminal instead.
    rate_hz : float
        Lines a second ("serial" only; a pic0rick fires on request).
    seed : int
        Of the faults and of the virtual patient.

    Raises
    ------
    InputError
        An unknown protocol or fault, or a recording that cannot be played.
    """
    if protocol not in PROTOCOLS:
        raise InputError(f"unknown protocol {protocol!r}; choose {' or '.join(PROTOCOLS)}")
    dice, source = Faults(faults, seed), open_source(replay, seed)
    device: EmulatedDevice
    if protocol == "pic0rick":
        device = Pic0rickShell(source, dice)
    elif isinstance(source, RawCodes):
        raise InputError("converter codes play only with --protocol pic0rick; give an .igs.mha recording")
    else:
        device = SerialPulser(source, dice, rate_hz)
    door: Door = PtyDoor() if pty else TcpDoor(port)
    run_until_interrupted(device, door)


def main() -> None:
    """The command line of this stand-in alone."""
    parser = argparse.ArgumentParser(description="an emulated A-mode device")
    parser.add_argument("--protocol", choices=PROTOCOLS, default="serial")
    parser.add_argument("--replay", type=Path)
    parser.add_argument("--fault", action="append", default=[], help=", ".join(DEFAULT_RATES))
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--pty", action="store_true")
    parser.add_argument("--rate-hz", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    try:
        emulate(given.protocol, given.replay, given.fault, given.port, given.pty, given.rate_hz, given.seed)
    except InputError as error:
        parser.exit(2, f"{error}\n")


if __name__ == "__main__":
    main()
