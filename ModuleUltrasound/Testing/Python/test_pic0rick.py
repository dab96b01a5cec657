"""The pic0rick driver against an emulated board: prompt, echo, gain, time zero, and everything that goes wrong."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.sequence_metafile import Acquisition, Recording, write_recording
from ModuleUltrasoundLib.devices import pic0rick_shell as shell
from ModuleUltrasoundLib.devices.connection import DeviceState
from ModuleUltrasoundLib.devices.device import AMODE_DEVICES, DeviceError
from ModuleUltrasoundLib.emulators.faults import Chunk, Faults
from ModuleUltrasoundLib.emulators.line_source import RawCodes, RecordedLines
from ModuleUltrasoundLib.emulators.pic0rick_shell import Pic0rickShell
from ModuleUltrasoundLib.emulators.server import PtyDoor, served

FORERUN = Acquisition(60e6, 5e6, 23.0, 2340.0)


def echo(times_s: np.ndarray, at_s: float, amplitude: float) -> np.ndarray:
    return amplitude * np.exp(-(((times_s - at_s) / 0.15e-6) ** 2)) * np.cos(2 * np.pi * 5e6 * (times_s - at_s))


def a_recording(count: int = 4) -> Recording:
    """Forerun face at 2 L / c, a bone echo behind it that moves from line to line."""
    times = np.arange(4200) / 60e6
    face = 2 * 23e-3 / 2340.0
    lines = [echo(times, face, 4500.0) + echo(times, face + 6e-6 + k * 0.4e-6, 2500.0) for k in range(count)]
    return Recording(
        lines=np.round(lines).astype(np.int16),
        acquisition=FORERUN,
        probe_to_reference=np.tile(np.eye(4), (count, 1, 1)),
        statuses=("OK",) * count,
        timestamps_s=np.arange(count) / 10.0,
        palpation_points=np.full(count, -1),
    )


def a_board(*faults: str, seed: int = 2, timeout_s: float = 0.05) -> Pic0rickShell:
    return Pic0rickShell(RecordedLines(a_recording()), Faults(faults, seed), read_s=0.0, timeout_s=timeout_s)


def settings_for(port: str, **more: str) -> dict[str, str]:
    return {"port": port, "forerun_length_mm": "23", "forerun_speed_m_s": "2340", **more}


def lines_of(device, count: int) -> list:
    taken = []
    while len(taken) < count:
        line = device.read(20.0)
        assert line is not None
        taken.append(line)
    return taken


def distance_to_a_recorded_line(samples: np.ndarray) -> float:
    """Largest difference to the nearest recorded line, behind the transmit pulse, in converter steps."""
    recorded = a_recording().lines[:, : len(samples)].astype(float)
    return float(np.abs(samples - recorded)[:, 150:].max(axis=1).min()) / shell.STEPS_A_CODE


# What the text and the numbers mean


def test_gain_follows_the_amplifiers_law_within_what_its_pin_follows():
    assert [shell.gain_db_of_code(code) for code in (0, 20, 245, 500, 1023)] == pytest.approx([7.5, 7.5, 30.0, 55.5, 55.5])
    assert [shell.gain_code(gain) for gain in (-5.0, 7.5, 30.0, 55.5, 90.0)] == [20, 20, 245, 500, 500]


def test_arguments_of_a_shot_are_whole_ticks_and_never_negative():
    assert shell.start_command(83.0, -5.0, 2001.0) == "start acq 80 0 2000"


def test_an_answer_needs_its_echo_and_a_prompt_at_the_end():
    assert shell.answer_to("read", b"read\r\nabc\r\nrun") is None
    assert shell.answer_to("read", b"\r\nrun> ") is None
    assert shell.answer_to("read", b"\r\nrun> read\r\nabc\r\nrun> ") == b"abc\r\n"


def printed(values: str) -> bytes:
    return shell.START_MARK + b"\r\n" + values.encode() + b"\r\n" + shell.END_MARK + b"\r\n"


def test_a_buffer_is_8000_values_of_ten_bits_between_whole_marks():
    good = "1FE," * 8000
    assert np.array_equal(shell.parse_codes(printed(good)), np.full(8000, 0x1FE))
    for bad, why in [
        (good[:-1], "marks"),
        (good[4:], "expected 8000 values, got 7999"),
        ("400," + good[4:], "over 1023"),
        ("1fe," + good[4:], "damaged"),
        ("," + good[4:], "empty"),
        ("0FE," + good[4:], "padded"),
        ("1FE1FE," + good[8:] + "1,", "too long"),
    ]:
        with pytest.raises(ValueError, match=why):
            shell.parse_codes(printed(bad))
    with pytest.raises(ValueError, match="marks"):
        shell.parse_codes(printed(good)[1:])


def test_sampling_rates_are_those_of_the_clock_dividers():
    assert shell.RP2350_SAMPLING_HZ == 60e6
    assert pytest.approx(59_925_094, abs=1) == shell.RP2040_SAMPLING_HZ


# On the line


@pytest.fixture(autouse=True)
def a_short_settling_time(monkeypatch):
    """The emulated board runs already: no need to wait for it to boot."""
    monkeypatch.setattr("ModuleUltrasoundLib.plugins.pic0rick.SETTLE_S", 0.05)
    monkeypatch.setattr("ModuleUltrasoundLib.plugins.pic0rick.QUIET_S", 0.1)


@pytest.mark.parametrize("door", ["tcp", "pty"])
def test_lines_begin_at_the_transmit_pulse_with_the_forerun_where_it_belongs(door):
    with served(a_board(), PtyDoor() if door == "pty" else None) as port:
        with AMODE_DEVICES.create("pic0rick", **settings_for(port)) as device:
            taken = lines_of(device, 4)
            assert device.acquisition == FORERUN
        assert device.state is DeviceState.CLOSED
    for line in taken:
        assert len(line.samples) == 3600
        assert distance_to_a_recorded_line(line.samples) < 12  # noise of a step or two on 3600 samples, half a sample of shift
        assert not line.saturated


def test_jitter_of_the_pulse_moves_no_echo():
    with served(a_board("bang-jitter")) as port, AMODE_DEVICES.create("pic0rick", **settings_for(port)) as device:
        taken = lines_of(device, 8)
    for line in taken:
        face = round(2 * 23e-3 / 2340.0 * 60e6)
        assert abs(int(np.argmax(line.samples[face - 60 : face + 60])) - 60) <= 1


def test_a_warm_delay_line_stays_in_the_line_for_the_measurement_to_see():
    """Its face echo comes later than the length and speed in the settings say, jitter or not."""
    with served(a_board("bang-jitter")) as port:
        settings = {**settings_for(port), "forerun_speed_m_s": "2380"}  # the lines are of 2340 m/s: 0.33 us later
        with AMODE_DEVICES.create("pic0rick", **settings) as device:
            taken = lines_of(device, 4)
    assert all(distance_to_a_recorded_line(line.samples) < 12 for line in taken)


def test_without_a_forerun_time_zero_is_the_constant_after_the_pulse():
    with served(a_board("bang-jitter")) as port, AMODE_DEVICES.create("pic0rick", port=port) as device:
        taken = lines_of(device, 4)
    assert all(distance_to_a_recorded_line(line.samples) < 12 for line in taken)


def test_averaging_lowers_the_noise_as_the_root_of_the_count():
    quiet = slice(2500, 3500)  # between the bone echo and the end: noise only
    spread = {}
    for count in (1, 9):
        with served(a_board()) as port, AMODE_DEVICES.create("pic0rick", port=port, averaging=str(count)) as device:
            spread[count] = float(np.mean([np.std(line.samples[quiet]) for line in lines_of(device, 2)]))
            assert device.counters["shots"] == 2 * count
    assert spread[1] / spread[9] == pytest.approx(3.0, rel=0.15)


def test_shots_of_a_line_that_takes_longer_than_the_reader_waits_are_not_lost():
    with served(a_board()) as port, AMODE_DEVICES.create("pic0rick", port=port, averaging="3") as device:
        taken = [device.read(0.0) for _ in range(6)]  # a shot each
    assert [line is not None for line in taken] == [False, False, True] * 2


def test_gain_is_written_at_connect_and_between_lines_only():
    board = a_board()
    with served(board) as port, AMODE_DEVICES.create("pic0rick", port=port, gain_db="20", averaging="4") as device:
        lines_of(device, 1)
        device.set_gain_db(99.0)
        line = lines_of(device, 1)[0]
    shots = ["start acq 88 88 2000", "read", "read"] * 4
    assert board.commands == ["write dac 145", *shots, "write dac 500", *shots]
    assert line.gain_db == 55.5


def test_auto_gain_backs_off_when_an_echo_clips():
    board = a_board()
    with served(board) as port, AMODE_DEVICES.create("pic0rick", port=port, gain_db="45", auto_gain="yes") as device:
        lines = lines_of(device, 12)
    assert lines[0].saturated
    assert not lines[-1].saturated
    gains = [line.gain_db for line in lines]
    assert gains[0] == pytest.approx(45.0)
    assert gains == sorted(gains, reverse=True)


@pytest.mark.parametrize(
    ("fault", "counter"),
    [
        ("byte-loss=0.4", "damaged reads"),
        ("bit-errors=0.4", "damaged reads"),
        ("adc-timeout=0.4", "ADC timeouts"),
        ("pulser-off=0.4", "no transmit pulse"),
        ("stall=0.1", ""),
        ("split-prompts", ""),
        ("extra-prompts=0.6", ""),
        ("stale-fragment", ""),
    ],
)
def test_each_fault_costs_time_but_never_gives_a_wrong_line(fault, counter):
    with served(a_board(fault)) as port, AMODE_DEVICES.create("pic0rick", **settings_for(port)) as device:
        taken = lines_of(device, 6)
    assert all(distance_to_a_recorded_line(line.samples) < 12 for line in taken)
    if counter:
        assert device.counters[counter] > 0


def test_all_faults_at_once_never_give_a_wrong_line():
    faults = ["byte-loss=0.15", "bit-errors=0.15", "adc-timeout", "extra-prompts", "stale-fragment", "bang-jitter", "pulser-off"]
    with served(a_board(*faults)) as port, AMODE_DEVICES.create("pic0rick", **settings_for(port)) as device:
        taken = lines_of(device, 12)
    assert all(distance_to_a_recorded_line(line.samples) < 12 for line in taken)


def test_a_pulled_cable_is_told_once_and_the_gain_written_again():
    board = a_board("disconnect=0.08")
    with served(board) as port, AMODE_DEVICES.create("pic0rick", port=port) as device:
        lost, good_after = 0, 0
        while good_after < 3:
            try:
                line = device.read(3.0)
            except DeviceError:
                assert device.state is DeviceState.LOST
                lost += 1
                continue
            good_after += bool(lost) and line is not None
    assert board.commands.count("write dac 245") >= 1 + device.counters["reconnects"]


class Talker:
    """Something else at the port: says the same whatever it is sent."""

    def __init__(self, words: bytes) -> None:
        self.words = words

    def greet(self) -> list[Chunk]:
        return []

    def tick(self, now_s: float) -> list[Chunk]:
        return []

    def receive(self, data: bytes, now_s: float) -> list[Chunk]:
        return [Chunk(self.words)]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (b"Enter a number between 0 and 9: ", "old menu firmware"),
        (b"ERR COMMAND unknown\r\n", "binary envelope firmware"),
        (b">>> ", "does not prompt like"),
        (b"", "nothing answers"),
    ],
)
def test_another_firmware_is_refused_by_name(words, message, monkeypatch):
    monkeypatch.setattr("ModuleUltrasoundLib.plugins.pic0rick.OPEN_S", 1.0)
    with served(Talker(words)) as port, pytest.raises(DeviceError, match=message):
        AMODE_DEVICES.create("pic0rick", port=port).open()


def test_settings_that_cannot_work_are_refused():
    with pytest.raises(InputError, match="trigger=software"):
        AMODE_DEVICES.create("pic0rick", port="x", trigger="external")
    with pytest.raises(InputError, match="needs forerun_length_mm"):
        AMODE_DEVICES.create("pic0rick", port="x", time_zero="forerun")
    with pytest.raises(InputError, match=r"gain_db is 90.*7.5 to 55.5 dB"):
        AMODE_DEVICES.create("pic0rick", port="x", gain_db="90")


def test_random_text_is_never_taken_for_a_buffer():
    good = printed("".join(f"{code:X}," for code in np.random.default_rng(0).integers(0, 1024, 8000)))
    whole = shell.parse_codes(good)
    for seed in range(300):
        rng = np.random.default_rng(seed)
        spoiled = b"".join(chunk.data for chunk in Faults(["byte-loss=1.0"], seed).spoil(good)[:1])
        at = int(rng.integers(len(spoiled)))
        spoiled = spoiled[:at] + rng.bytes(3) + spoiled[at:]
        try:
            codes = shell.parse_codes(spoiled)
        except ValueError:
            continue
        assert np.count_nonzero(codes != whole) <= 4  # a digit changed: what the second reading is for


# In a process of its own, and on real recordings


def test_the_emulator_runs_in_a_process_of_its_own(tmp_path):
    path = tmp_path / "lines.igs.mha"
    write_recording(path, a_recording())
    command = [sys.executable, "-m", "ModuleUltrasoundLib.emulators", "--protocol", "pic0rick", "--replay", str(path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        port = process.stdout.readline().strip()
        assert port.startswith("socket://127.0.0.1:")
        with AMODE_DEVICES.create("pic0rick", **settings_for(port)) as device:
            assert distance_to_a_recorded_line(lines_of(device, 1)[0].samples) < 12
    finally:
        process.terminate()
        assert process.wait(timeout=10) == 0


def test_real_boards_lines_come_through_with_their_echoes_in_place(amode_recordings):
    with np.load(amode_recordings / "pic0rick-water-steel-steps.npz") as stored:
        codes = stored["codes"]
    onsets = [shell.bang_onset(line) for line in codes]
    assert all(onset in (21, 22, 23) for onset in onsets)
    board = Pic0rickShell(RawCodes(codes), Faults(["bang-jitter", "byte-loss=0.1"], 4), read_s=0.0)
    with served(board) as port, AMODE_DEVICES.create("pic0rick", port=port, range_us="130") as device:
        taken = lines_of(device, 6)
    for line, raw, onset in zip(taken, codes, onsets):
        wanted = (raw[onset + 25 :] - 512) * shell.STEPS_A_CODE
        count = min(len(line.samples), len(wanted)) - 2
        assert np.array_equal(line.samples[:count], wanted[:count])
    assert any(line.saturated for line in taken)  # gain codes 100 and up clip the first echo
    assert not taken[0].saturated
