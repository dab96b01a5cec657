import numpy as np
import pytest
from CranioNavLib.sequence_metafile import Acquisition
from ModuleUltrasoundLib.echo.signal_chain import complex_envelopes, design_band
from ModuleUltrasoundLib.echo.static_echoes import believed, common_pattern, likeness

RATE, CENTRE = 60e6, 5e6
PLACES = np.repeat(np.arange(6), 5)
STATIC_S, NONE = 15e-6, np.zeros(len(PLACES))


def envelopes_with(echoes, noise=0.01, late_s=NONE):
    """Envelopes of lines with pulses at given times (s, or one a line) and heights, each line `late_s` late."""
    rng = np.random.default_rng(0)
    time = np.arange(2400) / RATE - late_s[:, None]
    lines = rng.normal(0, noise, time.shape)
    for at, height in echoes:
        t = time - np.broadcast_to(at, len(late_s))[:, None]
        lines += height * np.exp(-0.5 * (t * CENTRE / 0.5) ** 2) * np.cos(2 * np.pi * CENTRE * t)
    return complex_envelopes(np.round(8000 * lines).astype(np.int16), design_band(Acquisition(RATE, CENTRE), 2400, 1.0))


def likeness_at(envelopes, times_s, places=PLACES, late_s=NONE):
    samples = np.rint(np.broadcast_to(times_s, len(late_s)) * envelopes.rate_hz).astype(np.int64)
    return likeness(envelopes, common_pattern(envelopes, places, late_s, CENTRE), samples[:, None])[:, 0]


def bones(spread_s):
    """Bone at each place, at times that differ by `spread_s` (SD)."""
    return (11e-6 + np.random.default_rng(1).normal(0, spread_s, 6))[PLACES]


def test_echo_of_the_probe_is_told_from_bone_that_is_as_deep_everywhere():
    bone = bones(1.5e-7)  # a tenth of a millimetre
    envelopes = envelopes_with([(STATIC_S, 0.3), (bone, 0.6)])
    assert likeness_at(envelopes, STATIC_S).min() > 0.8
    assert np.median(likeness_at(envelopes, bone)) < 0.2


def test_pattern_follows_the_delay_line_that_warms():
    late_s = np.linspace(0, 1.5e-7, len(PLACES))
    envelopes = envelopes_with([(STATIC_S, 0.3)], late_s=late_s)
    assert likeness_at(envelopes, STATIC_S + late_s, late_s=late_s).min() > 0.7


def test_noise_is_like_no_pattern():
    assert likeness_at(envelopes_with([]), STATIC_S).max() < 0.3


@pytest.mark.parametrize("places", [np.zeros(30, dtype=np.int64), np.repeat([0, 1], 15)])
def test_a_place_or_two_tell_nothing(places):
    assert common_pattern(envelopes_with([(STATIC_S, 0.3)]), places, NONE, CENTRE) is None


def test_where_there_is_no_echo_there_is_no_likeness():
    envelopes = envelopes_with([(STATIC_S, 0.3)])
    pattern = common_pattern(envelopes, PLACES, NONE, CENTRE)
    assert not likeness(envelopes, pattern, np.full((30, 2), -1)).any()


def test_constant_echo_that_nothing_exceeds_is_a_scalp_as_thick_everywhere():
    likenesses = np.array([[0.9, 0.0], [0.9, 0.0], [0.9, 0.0], [0.0, 0.0]])
    weaker, stronger = np.full(4, 1.0), np.full(4, 3.0)
    assert not believed(likenesses, np.stack([stronger, weaker], axis=1)).any()
    np.testing.assert_allclose(believed(likenesses, np.stack([weaker, stronger], axis=1)), likenesses)
    half = np.stack([np.full(4, 2.0), [1.0, 3.0, 3.0, 3.0]], axis=1)
    np.testing.assert_allclose(believed(likenesses, half), likenesses * 2 / 3)


def test_echo_that_is_less_than_half_the_pattern_is_none_of_it():
    likenesses = np.array([[0.9, 0.4], [0.9, 0.4]])
    assert not believed(likenesses, np.array([[1.0, 3.0], [1.0, 3.0]]))[:, 1].any()
