"""The workstation's speed, measured in the browser: start, CT and bone, pose to picture, stalls, memory.

    python Testing/Benchmarks/workstation.py [start] [ct] [latency] [memory] [--minutes 10] [--runs 5] [--rate 60]

Each picture that the server sends carries the time at which the pose that it shows was taken (8 bytes behind the JPEG, which
decoders leave alone), and the page's worker notes when the frame is done in which it was drawn. Server and browser share one
computer and its clock.
Needs Chromium and the sample head. Everything tracked here is simulated.
"""

from __future__ import annotations

import argparse
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
STALL_S = 0.05  # shorter waits of the event loop are not looked at
WATCH_PICTURES = """
(() => {
  const inside = `
    const stamps = new Map(), names = new TextDecoder(), seen = new BroadcastChannel('seen-pictures');
    self.WebSocket = class extends self.WebSocket {
      constructor(address, ...rest) {
        super(address, ...rest);
        this.addEventListener('message', ({ data }) => {
          if (typeof data === 'string') return;
          const view = new DataView(data), area = names.decode(new Uint8Array(data, 5, view.getUint8(4)));
          stamps.set(JSON.stringify([area, view.getUint32(0, true)]), view.getFloat64(data.byteLength - 8, true));
          if (stamps.size > 400) stamps.delete(stamps.keys().next().value);
        });
      }
      send(message) {
        super.send(message);
        const [area] = JSON.parse(message), { width, height } = canvases.get(area);
        requestAnimationFrame(() => {  // it was drawn within a frame: when the next one begins, that one is done
          const shown = (performance.timeOrigin + performance.now()) / 1000;
          seen.postMessage([area, stamps.get(message), shown, width * height]);
        });
      }
    };
  `;
  window.seenPictures = [];
  new BroadcastChannel('seen-pictures').onmessage = ({ data: [area, ...seen] }) => {
    const canvases = [...document.querySelectorAll('canvas[data-picture]')];
    window.seenPictures.push([canvases.findIndex((one) => one.dataset.picture === area), ...seen]);
  };
  window.Blob = class extends window.Blob {  // the worker that draws begins with what notes it
    constructor(parts, options) {
      super(options && options.type === 'text/javascript' ? [inside, ...parts] : parts, options);
    }
  };
})();
"""


def run_stamped_server(arguments: list[str]) -> None:
    """`cranionav workstation` whose pictures carry the time of their newest pose; the loop's stalls go to stderr."""
    from Workstation.__main__ import main
    from Workstation.web.application import WorkstationApp
    from Workstation.web.pictures import Pictures

    lead, begun, offer = WorkstationApp._lead, Pictures.begun, Pictures.offer
    taken_s = [0.0]  # by the newest pose when the round began: the slices were put where that one is

    def lead_noted(self: Any) -> None:
        lead(self)
        taken_s[0] = newest_pose_s()

    def begun_noted(self: Any, area: str) -> Any:
        picture = begun(self, area)
        picture.taken_s = taken_s[0]  # type: ignore[attr-defined]
        return picture

    def offer_stamped(self: Any, picture: Any) -> None:
        picture.content += struct.pack("<d", picture.taken_s)
        offer(self, picture)

    WorkstationApp._lead, Pictures.begun, Pictures.offer = lead_noted, begun_noted, offer_stamped  # type: ignore[method-assign]
    watch_loop()
    sys.argv = ["cranionav", "workstation", *arguments]
    main()


def newest_pose_s() -> float:
    """Unix time at which the newest pose in the scene was taken; 0 without one."""
    from CranioNavLib import scene_data

    times = [scene_data.get_pose(f"{tool}ToReference").host_time_s for tool in ("Stylus", "Probe", "Sphere")]
    known = [taken for taken in times if taken == taken and taken > 0]
    return max(known) + time.time() - time.monotonic() if known else 0.0


def watch_loop() -> None:
    """Print every stall of the event loop: `stall <seconds>`."""
    import asyncio

    run = asyncio.events.Handle._run
    read_s = used = 0.0  # the thread's processor time, and when it was read: reading it each time would cost too much

    def timed(self: Any) -> None:
        nonlocal read_s, used
        begun = time.monotonic()
        if begun > read_s + STALL_S / 2:
            read_s, used = begun, time.thread_time()
        run(self)
        if time.monotonic() - begun > STALL_S:
            what = getattr(self._callback, "__qualname__", "") or repr(self._callback)[:80]
            inner = getattr(getattr(self._callback, "__self__", None), "get_coro", lambda: "")()
            name = getattr(inner, "__qualname__", what)
            print(f"stall {time.monotonic() - begun:.3f} {time.thread_time() - used:.3f} {name}", file=sys.stderr, flush=True)

    asyncio.events.Handle._run = timed  # type: ignore[method-assign]


@contextmanager
def served(folder: Path, *arguments: str) -> Iterator[tuple[str, subprocess.Popen[str], Path]]:
    """A stamped server: its address, its process, its log."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, __file__, "--serve", "--no-browser", "--case", str(folder), *arguments]
    log = folder.parent / "workstation.log"
    with (
        log.open("w") as errors,
        subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=errors, text=True) as process,
    ):
        try:
            assert process.stdout is not None
            yield process.stdout.readline().strip(), process, log
        finally:
            process.kill()


def load() -> str:
    """How busy the computer is with other things."""
    return f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"


def measure_start(runs: int) -> None:
    """From the command to a page that can be used, with the browser already open."""
    seconds, cpu = [], []
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # once set up, a program is not compiled anew at each start
    from Testing.Python import workstation_user

    with workstation_user.browsing() as user:
        for _ in range(runs + 1):
            with tempfile.TemporaryDirectory() as scratch:
                begun = time.monotonic()
                with workstation_user.served(Path(scratch) / "session") as (url, process):
                    user.open(url)
                    user.page.locator("[data-panel=ct] [data-action=layPatient]:not([disabled])").wait_for()
                    seconds.append(time.monotonic() - begun)
                    cpu.append(_cpu_s(process.pid))
    seconds, cpu = seconds[1:], cpu[1:]  # the first one compiles
    print(f"start to usable page: {_spread(seconds)} s, the server's processor time {np.median(cpu):.1f} s (limit 6; {load()})")


def measure_ct() -> None:
    """CT 512 x 512 x 110 loaded, and its bone on the screen."""
    with tempfile.TemporaryDirectory() as scratch:
        ct = Path(scratch) / "session" / "ct.nrrd"
        ct.parent.mkdir()
        write_large_ct(ct)
        with served(Path(scratch) / "session") as (url, _, log), watched_browser() as user:
            user.open(url)
            field = user.page.locator("[data-panel=ct] [data-field=ct_path] input")
            field.fill("session/ct.nrrd")
            field.press("Enter")
            begun = time.monotonic()
            user.press("ct", "loadCt")
            user.sees("ct", "512 × 512 × 110 voxels")
            loaded = time.monotonic()
            user.next("ct")
            user.press("bone", "segmentBone")
            user.sees("bone", "on the outer table")
            wait_for_quiet(user)
            done = time.monotonic()
        print(f"CT 512x512x110: loaded {loaded - begun:.1f} s, bone visible after {done - begun:.1f} s (limit 10; {load()})")
        print(f"longest stall of the interface meanwhile: {longest_stall(log)}")


def write_large_ct(path: Path) -> None:
    """The sample head, resampled to 512 x 512 x 110."""
    import SimpleITK as sitk
    from CranioNavLib.phantom.case_writer import write_volume
    from CranioNavLib.sample_head import load_sample_head

    write_volume(path, load_sample_head())
    image = sitk.ReadImage(str(path))
    size, wanted = np.array(image.GetSize()), np.array([512, 512, 110])
    spacing = np.array(image.GetSpacing()) * size / wanted
    finer = sitk.Resample(
        image, wanted.tolist(), sitk.Transform(), sitk.sitkLinear, image.GetOrigin(), spacing.tolist(), image.GetDirection()
    )
    sitk.WriteImage(finer, str(path))


def measure_latency(seconds: float, rate_hz: float) -> None:
    """From a pose taken to the picture that shows it, in each view, while the stylus visits the targets."""
    with tempfile.TemporaryDirectory() as scratch:
        with served(Path(scratch) / "session") as (url, process, log), watched_browser() as user:
            navigate(user, url, rate_hz)
            user.page.wait_for_timeout(3000)
            user.page.evaluate("window.seenPictures.length = 0")
            used, begun = _cpu_s(process.pid), time.monotonic()
            user.page.wait_for_timeout(1000 * seconds)
            pictures = np.array(user.page.evaluate("window.seenPictures"))
            share = (_cpu_s(process.pid) - used) / (time.monotonic() - begun)
        for view in range(4):
            of_view = pictures[pictures[:, 0] == view]
            new = of_view[np.concatenate([[True], np.diff(of_view[:, 1]) > 0])]
            waits = 1e3 * (new[:, 2] - new[:, 1])
            print(
                f"view {view + 1}: pose to picture {np.median(waits):.0f} ms median, {np.percentile(waits, 95):.0f} ms 95%, "
                f"{len(new) / seconds:.1f} pictures a second, {int(new[-1, 3])} pixels"
            )
        print(f"(limit 100 ms and 20 a second; {rate_hz:g} poses a second; the server used {share:.2f} cores; {load()})")
        print(f"longest stall of the interface in the whole run: {longest_stall(log)}")


def measure_memory(minutes: float) -> None:
    """Growth of the server's memory while a tool is tracked and drawn."""
    with (
        tempfile.TemporaryDirectory() as scratch,
        served(Path(scratch) / "session") as (url, process, _),
        watched_browser() as user,
    ):
        navigate(user, url)
        user.page.wait_for_timeout(15_000)
        at, used = [], []
        begun = time.monotonic()
        while time.monotonic() < begun + 60 * minutes:
            at.append((time.monotonic() - begun) / 60)
            used.append(_memory_mb(process.pid))
            if user.page.locator("[data-panel=navigation] [data-action=tourTargets]:not([disabled])").count():
                user.press("navigation", "tourTargets")
            user.page.evaluate("window.seenPictures.length = 0")
            user.page.wait_for_timeout(20_000)
        growth = np.polyfit(at, used, 1)[0]
        print(
            f"memory: {used[0]:.0f} MB at first, {used[-1]:.0f} MB after {at[-1]:.1f} minutes; {growth:+.2f} MB a minute, "
            f"so {used[0] + 60 * growth:.0f} MB after an hour (limit 2500; {load()})"
        )


def navigate(user: Any, url: str, rate_hz: float = 0.0) -> None:
    """Click through to navigation by landmarks alone, and let the stylus travel; with as many poses a second as wanted."""
    user.open(url)
    user.press("ct", "layPatient")
    user.sees("ct", "simulated patient: sample head")
    user.next("ct")
    user.press("bone", "segmentBone")
    user.sees("bone", "on the outer table")
    user.next("bone")
    if rate_hz:
        user.page.locator("[data-panel=devices] .v-expansion-panel-title").first.click()
        user.page.get_by_label("rate hz").fill(f"{rate_hz:g}")
        user.page.get_by_label("rate hz").press("Enter")
    user.press("devices", "connect", 0)
    user.sees("devices", r"\d+ frames a second")
    user.step("landmarks")
    user.digitise_landmarks()
    user.press("landmarks", "registerLandmarks")
    user.sees("landmarks", r"4 landmark pairs, FRE \d")
    user.step("navigation")
    user.press("navigation", "tourTargets")


def wait_for_quiet(user: Any) -> None:
    """Until no new picture has come for half a second."""
    count = -1
    while (now := user.page.evaluate("window.seenPictures.length")) != count:
        count = now
        user.page.wait_for_timeout(500)


@contextmanager
def watched_browser() -> Iterator[Any]:
    """A user whose page notes its pictures."""
    from Testing.Python import workstation_user

    with workstation_user.browsing() as user:
        user.page.add_init_script(WATCH_PICTURES)
        user.page.set_default_timeout(90_000)
        yield user


def longest_stall(log: Path) -> str:
    """The longest entries of the server's log."""
    stalls = sorted(
        (line.split()[1:] for line in log.read_text().splitlines() if line.startswith("stall ")), key=lambda s: -float(s[0])
    )
    return (
        "; ".join(f"{wall} s ({cpu} s of processor time) in {' '.join(name)}" for wall, cpu, *name in stalls[:5])
        or f"under {STALL_S} s"
    )


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _memory_mb(pid: int) -> float:
    return (
        next(int(line.split()[1]) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmRSS"))
        / 1024
    )


def _spread(values: list[float]) -> str:
    return f"{np.median(values):.1f} (median of {len(values)}; {min(values):.1f} to {max(values):.1f})"


def main() -> None:
    """The measurements that are named, or all."""
    if sys.argv[1:2] == ["--serve"]:
        run_stamped_server(sys.argv[2:])
        return
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", nargs="*", help="start, ct, latency, memory; all by default")
    parser.add_argument("--runs", type=int, default=5, help="of the start")
    parser.add_argument("--seconds", type=float, default=20.0, help="of tracking, for the latency")
    parser.add_argument("--rate", type=float, default=60.0, help="poses a second, for the latency: a Polaris Spectra gives 60")
    parser.add_argument("--minutes", type=float, default=10.0, help="of tracking, for the memory")
    wanted = parser.parse_args()
    measurements = {
        "start": lambda: measure_start(wanted.runs),
        "ct": measure_ct,
        "latency": lambda: measure_latency(wanted.seconds, wanted.rate),
        "memory": lambda: measure_memory(wanted.minutes),
    }
    for name in wanted.what or measurements:
        measurements[name]()


if __name__ == "__main__":
    main()
