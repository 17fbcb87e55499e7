"""Figures and verdicts of motions that are known in closed form."""

import json
import math
import tracemalloc

import numpy as np
import pytest
from synthetic import RATE, make_bands, make_play, make_recorder, make_recording, make_signals, summary_of, times

import hapticrender as hr
from hapticrender.protocols import Flag
from hapticrender.recordings import envelopes, journal, judge, waveform_figures

EXACT = 1e-9  # relative: the ridge of 1e-12 times the inverse of the worst inflation, with digits to spare
UM = 1e-6


def only(recording):
    (band,) = recording.summary()["bands"]
    return band


def test_constant_envelopes_give_their_errors_exactly():
    bands = make_bands(170.0, 10 * UM)
    turned = 10 * UM * np.array([1.02 * np.exp(0.3j), 0.9, 1.5])[:, None]
    summary = make_recording(bands, turned).summary()
    (band,) = summary["bands"]
    assert band["target"] == pytest.approx(10 * UM, rel=EXACT)
    assert band["achieved"] == pytest.approx(10.2 * UM, rel=EXACT)
    for place, error in (("centre", 0.02), ("end_1", -0.1), ("end_2", 0.5)):
        assert band[f"error_{place}"] == pytest.approx(error, abs=EXACT)
        assert band[f"rms_error_{place}"] == pytest.approx(abs(error), abs=EXACT)
    assert band["phase_error"] == pytest.approx(0.3, abs=EXACT)
    assert band["settling_time"] is None  # 0.3 rad are 30 % of the target
    assert summary["wobble"] < EXACT * UM
    decides = {"figure": "waveform_error", "bound": 0.1, "band": "20 to 500 Hz", "place": "end 2"}
    assert summary["worst"] == decides | {"value": pytest.approx(0.5, abs=EXACT)}


def test_a_chirped_finger_locked_carrier_is_followed():
    time = times(2.0)
    position = -0.05 + 0.03 * time + 0.03 * time**2  # 30 to 150 Hz at 1 mm
    bands = make_bands([0.0, 0.0], [10 * UM, 3 * UM], wavenumber=[1000.0, 2000.0], phase=[0.4, 1.0])
    recording = make_recording(bands, 1.1 * bands.envelope, position=position, duration=2.0, scene={"settle": 0.0})
    assert recording.envelopes.judged.all()
    late = recording.envelopes.time[recording.envelopes.start >= envelopes.FADE_IN]
    for band in recording.summary()["bands"]:
        middle = 30.0 + 60.0 * np.median(late)  # Hz; a sample is 60 Hz/s / RATE of it
        assert band["frequency"] * band["wavelength"] * 1e3 == pytest.approx(middle, abs=60.0 / RATE)
        assert band["error_centre"] == pytest.approx(0.1, abs=EXACT)
        assert band["phase_error"] == pytest.approx(0.0, abs=EXACT)


def test_settling_time_of_a_first_order_rise():
    pole, bands = 25.0, make_bands(200.0, 10 * UM)
    rise = 1 - np.exp(-pole * times(4.0))[:, None, None]
    recording = make_recording(bands, rise * bands.envelope)
    window = recording.envelopes.window
    smoothing = math.log(math.sinh(pole * window / 2) / (pole * window / 2)) / pole  # a window's mean of exp(-a t)
    late = only(recording)["settling_time"] - math.log(1 / judge.SETTLED) / pole - smoothing
    assert -1e-3 < late < window / 2 + 1e-3  # one hop; 1 ms for the fit's weights, which are not quite even


@pytest.mark.parametrize(
    ("duration", "inside_for", "settled"),
    [(4.0, 0.34, True), (4.0, 0.26, False), (16.0, 0.56, True), (16.0, 0.44, False)],
)
def test_a_band_settles_only_if_it_stays_for_half_a_second_or_a_tenth(duration, inside_for, settled):
    """Judged from 1 s: the last 0.3 s of 4 s, the last 0.5 s of 16 s; a window is 20 ms, a hop 10 ms."""
    bands = make_bands(200.0, 10 * UM)
    enters = np.where(times(duration) > duration - inside_for, 1.0, 0.9)[:, None, None]
    recording = make_recording(bands, enters * bands.envelope, duration=duration)
    time = only(recording)["settling_time"]
    assert time == (pytest.approx(duration - inside_for, abs=recording.envelopes.window) if settled else None)


def test_what_is_neither_a_band_nor_slow_is_no_wobble():
    """A line at 190 Hz has 19 periods in the window of 0.1 s, so it is orthogonal to all but the slope."""
    bands, time = make_bands(20.0, 10 * UM), times(4.0)
    slow = (-11 * UM + 3 * UM * time)[:, None]
    line = (0.158 * UM * math.sqrt(2) * np.cos(2 * np.pi * 190 * time))[:, None]
    spurious = make_recording(bands, 1.3 * bands.envelope, extra=slow + line).summary()
    assert spurious["wobble"] < 0.01 * 0.158 * UM


@pytest.mark.parametrize("turn", [1, 1j], ids=["amplitude", "phase"])
def test_wobble_is_the_rms_of_the_waveform_that_modulation_adds(turn):
    bands, depth = make_bands(100.0, 10 * UM), 0.01
    swing = 1 + turn * depth * np.cos(2 * np.pi * 2.0 * times(4.0))[:, None, None]
    recording = make_recording(bands, swing * bands.envelope)
    added = 10 * UM * depth / 2 * np.sinc(2.0 * recording.envelopes.window)
    assert recording.summary()["wobble"] == pytest.approx(added, rel=2e-3)  # the ends of the judged time


def test_windows_with_a_slow_a_lifted_or_an_idle_finger_are_left_out():
    time = times(4.0)
    # 60 mm/s, standing from 1 to 2 s, moving, up from 2.5 to 3 s, moving with no target from 3.5 s
    position = np.cumsum(np.where((time > 1) & (time < 2), 0.0, 0.06)) / RATE - 0.1
    position[(time >= 2.5) & (time < 3)] = np.nan
    bands = make_bands(0.0, 10 * UM, wavenumber=1000.0)
    target = np.where(time >= 3.5, 0.0, 10 * UM)[:, None]
    recording = make_recording(bands, bands.envelope, position=position, target=target, scene={"settle": 0.0})
    envelopes = recording.envelopes
    start, end = envelopes.start, envelopes.start + envelopes.window
    free = (end <= 1) | ((start >= 2) & (end <= 2.5)) | ((start >= 3) & (end <= 3.5))
    blocked = (
        ((start >= 1) & (end <= 2)) | ((end > 2.5) & (start < 3)) | (end > 3.5 + 1 / RATE)
    )  # windows across the edge of the standstill may be either
    assert free.sum() > 20
    assert envelopes.judged[free].all()
    assert not envelopes.judged[blocked].any()
    (note,) = recording.summary()["notes"]
    assert note.startswith("1 mm (60 Hz): ")
    assert "faster" not in note


@pytest.mark.parametrize(
    ("duration", "settle", "expected"), [(4.0, 1.0, 1.0), (2.0, 1.0, 1.0), (1.9, 1.0, 0.95), (1.0, 0.0, 0.05)]
)
def test_judged_from_the_settling_time_or_the_last_half(duration, settle, expected):
    bands = make_bands(100.0, 10 * UM)
    recording = make_recording(bands, bands.envelope, duration=duration, scene={"settle": settle})
    assert recording.summary()["judged_from"] == pytest.approx(expected)


def test_a_lead_in_time_is_a_lead_whichever_way_the_finger_goes():
    """A motion 0.2 ms early leads by 2 pi f 0.2 ms on both strokes; averaged without regard to them it would be 0.

    A window with a turn at a share s <= 1/2 from either of its ends shows 1 - 2 s of the lead, half of it on average.
    """
    speed, wavelength, early, stroke = 0.08, 1e-3, 2e-4, 0.625  # strokes of 50 mm
    time = times(4.0)
    back = (time % (2 * stroke)) >= stroke
    position = np.where(back, 0.05 - speed * (time % stroke), speed * (time % stroke)) - 0.025
    bands = make_bands(0.0, 1e-5, wavenumber=1 / wavelength)
    lead = 2 * np.pi * speed / wavelength * early
    turned = 1e-5 * np.exp(1j * np.where(back, -lead, lead))[:, None, None]
    recording = make_recording(bands, turned, position=position)
    band, envelopes = only(recording), recording.envelopes
    turning = envelopes.window / stroke  # share of the windows that hold one
    assert band["phase_error"] == pytest.approx(lead, rel=turning / 2)
    whole = envelopes.start % stroke + envelopes.window < stroke
    ahead = np.where(envelopes.backward[whole, 0], -lead, lead)
    np.testing.assert_allclose(np.angle(envelopes.achieved[whole, 0, 0]), ahead, rtol=EXACT)
    backward = envelopes.backward[envelopes.judged]
    assert backward.any()
    assert not backward.all()


@pytest.mark.parametrize(
    ("bands", "fields", "reason"),
    [
        (make_bands(100.0, 1e-5), {"motion_source": "unknown", "extra": np.nan}, "the device has no sensors"),
        (make_bands(10.0, 1e-5), {}, "the texture has nothing from 20 to 500 Hz"),
        (make_bands(100.0, 0.0), {}, "the texture is zero"),
        *((make_bands(100.0, 1e-5), {"duration": n / RATE}, "the run is too short: needs >= 0.2 s") for n in (0, 900)),
    ],
)  # fmt: skip
def test_what_has_no_figure_is_not_judged(bands, fields, reason):
    """Half of 0.2 s is a window of 100 ms."""
    summary = make_recording(bands, bands.envelope, scene={"duration": 4.0}, **fields).summary()
    assert (summary["verdict"], summary["passed"], summary["worst"]["value"]) == ("not judged", False, None)
    assert summary["reason"].startswith(reason)
    json.dumps(summary, allow_nan=False)


@pytest.mark.parametrize(
    ("frequency", "seconds"), [*((each, 4.0) for each in (15.0, 17.0, 18.0, 501.0, 502.0, 503.0)), (5.0, 0.4)]
)
def test_a_tone_beside_the_band_is_not_judged_whatever_the_motion(rng, frequency, seconds):
    """No figure divides by what is left of it in the band: 1 nm of noise beside it read 1e9 %."""
    tone = 10 * UM * np.cos(2 * np.pi * frequency * times(seconds))
    for motion in (tone, 0.0 * tone, tone + 1e-9 * rng.standard_normal(len(tone))):
        summary = make_play(tone, motion).summary()
        assert (summary["verdict"], summary["worst"]["value"]) == ("not judged", None)
        assert summary["reason"] == "the texture has nothing from 20 to 500 Hz"


@pytest.mark.parametrize("frequency", [20.0, 21.0, 499.0])
@pytest.mark.parametrize(("gain", "found"), [(0.91, "passed"), (0.89, "failed")])
def test_a_tone_at_an_edge_of_the_band_is_judged(frequency, gain, found):
    tone = 10 * UM * np.cos(2 * np.pi * frequency * times(4.0))
    figures, verdict = judged(tone, gain * tone)
    assert verdict == found
    assert figures["waveform_error"] == pytest.approx(1.0 - gain, rel=1e-6)


@pytest.mark.parametrize("outside", [5.0, 900.0])
@pytest.mark.parametrize(("gain", "found"), [(0.92, "passed in band"), (0.88, "failed")])
def test_a_thousandth_of_the_energy_in_the_band_is_judged_by_itself(outside, gain, found):
    far, near = (30 * UM * np.cos(2 * np.pi * hertz * times(4.0)) for hertz in (outside, 90.0))
    near *= math.sqrt(1e-3)
    summary = make_play(far + near, far + gain * near).summary()
    assert summary["verdict"] == found
    assert summary["waveform"]["share_outside"] == pytest.approx(0.999, abs=1e-5)
    assert summary["waveform"]["places"]["centre"]["waveform_error"] == pytest.approx(1.0 - gain, rel=0.01)


def test_a_long_journal_is_judged_without_being_loaded(tmp_path, monkeypatch):
    """A minute of 14 columns is 34 MB; in pieces of a quarter judging takes less than seven tenths of that.

    A piece of windows has CHUNK_VALUES regressors of 8 bytes, their transposed copy, products, phases and signals: five
    times that at most.  What is kept of each of the 5998 windows is less than 150 bytes a band.
    """
    for module in (envelopes, journal):
        monkeypatch.setattr(module, "CHUNK_VALUES", module.CHUNK_VALUES // 4)
    bands = make_bands([100.0, 250.0], [10 * UM, 3 * UM])
    with make_recorder(tmp_path / "long.au", bands, duration=60.0) as recorder:
        recorder.append(**make_signals(bands, bands.envelope * 1.01, duration=60.0))
    recording = recorder.finish()
    tracemalloc.start()
    try:
        summary = recording.summary()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert summary["bands"][1]["rms_error_centre"] == pytest.approx(0.01, rel=1e-6)
    assert summary["worst"]["value"] == pytest.approx(0.01, rel=1e-3)
    assert peak < 5 * 8 * envelopes.CHUNK_VALUES + 150 * 5998 * 2


def white(low, high, rng, seconds=4.0, rms=5 * UM):
    """Every quarter of a Hz from `low` to `high` (Hz) alike, at random phases."""
    spectrum = np.zeros(round(seconds * RATE) // 2 + 1, complex)
    kept = slice(round(low * seconds), round(high * seconds))
    spectrum[kept] = np.exp(2j * np.pi * rng.random(kept.stop - kept.start))
    values = np.fft.irfft(spectrum)
    return values * rms / np.std(values)


def judged(reference, motion, **fields):
    summary = make_play(reference, motion, **fields).summary()
    return summary["waveform"]["places"]["centre"], summary["verdict"]


def test_errors_of_white_noise_are_those_of_theory(rng):
    """Silence 100 %, gain .9 10 %, one sample late the rms of 2 sin(pi f T) (29.7 %), an octave less sqrt(200/380)."""
    noise, hertz = white(20, 400, rng), np.arange(20.0, 400.0)
    late = np.sqrt(np.mean(4 * np.sin(np.pi * hertz / RATE) ** 2))
    assert late == pytest.approx(0.297, abs=2e-3)
    low = np.fft.irfft(np.where(np.fft.rfftfreq(len(noise), 1 / RATE) < 200.0, np.fft.rfft(noise), 0.0))
    for motion, error, within in (
        (0 * noise, 1.0, EXACT),
        (0.9 * noise, 0.1, EXACT),
        (np.roll(noise, 1), late, 0.02),  # 4 s of noise
        (low, math.sqrt(200 / 380), 0.02),
    ):
        figures, found = judged(noise, motion, tolerance=0.0999)
        assert figures["waveform_error"] == pytest.approx(error, rel=within)
        assert found == "failed"
    assert figures["third_octaves"]["400 Hz"] == pytest.approx(1.0, rel=1e-6)
    assert figures["third_octaves"]["100 Hz"] < 1e-3
    assert judged(noise, 0.9 * noise, tolerance=0.1001)[1] == "passed"


@pytest.mark.parametrize("frequency", [31.5, 250.0, 500.0, 1000.0])
@pytest.mark.parametrize(("times_threshold", "found"), [(0.9, "passed"), (1.1, "failed")])
def test_a_spur_fails_where_it_is_felt(frequency, times_threshold, found):
    """From 500 Hz on what the texture has there need not be played; no motion at all, or half of it, is no spur."""
    time = times(4.0)
    spur = times_threshold * hr.detection_threshold(frequency, "classic") * np.cos(2 * np.pi * frequency * time)
    tone = 50 * UM * np.cos(2 * np.pi * 160 * time)
    figures, verdict = judged(tone, tone + spur)
    assert (figures["third_octave"], verdict) == (f"{frequency:g} Hz", found)
    assert figures["third_octave_error"] == pytest.approx(0.2 * times_threshold, rel=0.03)
    for share in (0.0, 0.5) if frequency >= 500.0 else ():
        assert judged(tone + 20 * spur, tone + 20 * share * spur)[0]["third_octave_error"] < EXACT


def test_what_no_plate_can_play_is_said(rng):
    """White to 1500 Hz, of which 1000 in 1480 lie above 500 Hz."""
    noise = white(20, 1500, rng)
    played = np.fft.irfft(np.where(np.fft.rfftfreq(len(noise), 1 / RATE) < 500.0, np.fft.rfft(noise), 0.0))
    summary = make_play(noise, played).summary()
    assert (summary["verdict"], summary["passed"]) == ("passed in band", False)
    assert any(note.startswith("not judged: 6") for note in summary["notes"])
    assert summary["waveform"]["share_outside"] == pytest.approx(1000 / 1480, abs=0.02)  # 4 s of noise
    faint = make_play(noise + 1e-9 * np.cos(2 * np.pi * 700 * times(4.0)) - noise + played, played).summary()
    assert faint["verdict"] == "passed"  # 1 nm at 700 Hz is below the threshold


def test_a_short_failure_shows_in_the_worst_windows(rng):
    """Of 39 windows three are silent: more than 5 %, and 28 % of the whole."""
    noise = white(20, 400, rng)
    motion = np.where((times(4.0) > 2.05) & (times(4.0) < 2.35), 0.0, noise)
    figures, found = judged(noise, motion, tolerance=0.4)
    assert (figures["waveform_error"] < 0.35, found) == (True, "failed")
    assert figures["window_error"] > 0.9


def test_delay_and_gain_are_found_and_decide_nothing(rng):
    noise = white(20, 400, rng)
    found = make_play(noise, 0.9 * np.roll(noise, 7)).summary()["waveform"]
    assert found["delay"] == pytest.approx(7 / RATE, abs=1e-5)
    assert found["gain"] == pytest.approx(0.9, rel=0.01)
    assert found["incoherent"] < 0.01
    assert found["places"]["centre"]["waveform_error"] > 0.5


@pytest.mark.parametrize(("first", "count"), [(15000, 1), (0, 5000)])
def test_flags_are_counted_and_a_saturated_sample_that_is_judged_fails(first, count):
    """Judged from 1 s, 5000 samples, on."""
    bands = make_bands(100.0, 10 * UM)
    signals = make_signals(bands, bands.envelope)
    signals["flags"][first : first + count] = Flag.SATURATED
    signals["flags"][4000:4100] |= Flag.SENSOR_CLIPPED
    summary = summary_of(bands, signals)
    assert summary["flags"] == {"SATURATED": count, "SENSOR_CLIPPED": 100}
    assert summary["saturated_share"] == count / 20_000
    found = ("failed", "saturated in 1 samples") if first else ("passed", "")
    assert (summary["verdict"], summary["reason"][-22:]) == found
    assert summary["worst"]["value"] == pytest.approx(0.0, abs=EXACT)


def test_pieces_of_any_size_give_the_same_figures(rng, monkeypatch):
    noise = white(20, 400, rng)
    expected = make_play(noise, 0.9 * noise + 0.1 * np.roll(noise, 3)).waveform["places"]["centre"]
    monkeypatch.setattr(waveform_figures, "READ_AT_ONCE", 3000)
    found = make_play(noise, 0.9 * noise + 0.1 * np.roll(noise, 3)).waveform["places"]["centre"]
    assert found["window_error"] == pytest.approx(expected["window_error"], rel=1e-4)


@pytest.mark.parametrize("value", [1e200, np.nan])
@pytest.mark.parametrize("broken", ["texture", "motion"])
def test_a_texture_or_a_motion_that_is_no_number_does_not_pass(rng, value, broken):
    """As in a file that was corrupted: every figure would be NaN, and no NaN is above a bound."""
    noise = white(20, 400, rng)
    texture, motion = noise.copy(), noise.copy()
    (texture if broken == "texture" else motion)[len(noise) // 2] = value
    summary = make_play(texture, motion).summary()
    assert summary["verdict"] == "failed"
    assert "the motion, or the texture, is not finite, or beyond 1000 m, in 1 windows" in summary["reason"]
    json.dumps(summary, allow_nan=False)


def test_a_forced_scaling_is_stated():
    """20 um at 300 Hz take 0.25 A while they last and more as they begin; both runs are alike until the limit acts."""
    texture = hr.Recorded(samples=20 * UM * np.sin(600 * np.pi * times(2.0)), rate=RATE, gain=1.0)
    whole, scaled = (
        hr.render(hr.Scene(texture=texture, duration=2.0, limits={"peak_drive": limit})) for limit in (0.5, 0.26)
    )
    assert whole.least_scale == 1.0
    assert not any("scaled" in note for note in whole.summary()["notes"])
    assert 0.26 / abs(whole.drive).max() - 2e-3 < scaled.least_scale < 0.99  # 2e-3 of 0.3 A: half the converter's step
    stated = f"scaled the texture to {scaled.least_scale:.2g} of it at the least"
    assert [note for note in scaled.summary()["notes"] if stated in note]
    assert (scaled.flags & Flag.SATURATED).any()


def test_errors_after_touches_and_lifts_are_stated_apart(rng):
    """10 % of the reference is left out for 50 ms after each of three contacts, and 4 % in the 150 ms after that.

    Filters without phase carry some 5 ms over each edge: 5 of 50 ms.
    """
    noise, on = white(20, 400, rng), np.array([1.0, 1.8, 2.6])
    since = np.min(np.where(times(4.0) >= on[:, None], times(4.0) - on[:, None], np.inf), axis=0)
    motion = noise * (1.0 - np.where(since < 0.05, 0.1, np.where(since < 0.2, 0.04, 0.0)))
    touching = ((times(4.0) >= 1.0) & (times(4.0) < 1.8)) | (times(4.0) >= 2.6)
    for position, count in ((np.where(touching, 0.0, np.nan), 3), (np.nan * touching, 0)):
        recording = make_play(noise, motion, position=position, settle=0.5)
        contacts = recording.summary()["waveform"]["contacts"]
        assert contacts["count"] == count
        stated = "touches and lifts: error" in recording.text()
        assert stated == bool(count)
        if count:
            assert contacts["error_0_50_ms"] == pytest.approx(0.1, rel=0.25)
            assert contacts["error_50_200_ms"] == pytest.approx(0.04, rel=0.25)
        else:
            assert contacts["error_0_50_ms"] is contacts["error_50_200_ms"] is None


@pytest.mark.parametrize("left", [0.05, 0.09])
@pytest.mark.parametrize(("last", "found"), [(1.0, "passed"), (0.0, "failed"), (np.nan, "failed")])
def test_a_run_is_judged_to_its_end(rng, left, last, found):
    """The end after 10 whole windows of 100 ms; the 95th percentile of 11 is halfway between the worst two."""
    noise = white(20, 400, rng, seconds=2.0)[: round((1.5 + left) * RATE)]
    motion = np.where(np.arange(len(noise)) >= round(1.5 * RATE), last, 1.0) * noise
    summary = make_play(noise, motion, settle=0.5).summary()
    assert summary["judged_from"] == 0.5
    assert summary["verdict"] == found
    assert summary["waveform"]["lost_windows"] == (1 if math.isnan(last) else 0)


@pytest.mark.parametrize("silent", [1.0, 2.4, 3.9], ids=["start", "middle", "end"])
def test_a_tenth_of_a_second_of_silence_counts_wherever_it_is(silent):
    """0.1 s of 4 s: sqrt(0.1/4) = 16 %; spectra count a sample 2/3 to 3/2 times, by where it is in two Hann windows."""
    time = times(4.0)
    tone = 50e-6 * np.cos(2 * np.pi * 120.0 * time)
    motion = np.where((time >= silent) & (time < silent + 0.1), 0.0, tone)
    figures, verdict = judged(tone, motion, tolerance=0.15)
    assert 0.99 < figures["waveform_error"] / math.sqrt(0.1 / 4.0) < math.sqrt(3 / 2)
    assert verdict == "failed"


def test_the_sample_that_ends_a_run_which_was_cut_off_is_not_judged():
    bands = make_bands(100.0, 10 * UM)
    recorder = make_recorder(None, bands)
    recorder.append(**make_signals(bands, bands.envelope, extra=20 * UM))
    recorder.close(stopped=True)
    recording = recorder.finish()
    assert np.isnan(recording.motion[-1]).all()
    summary = recording.summary()
    assert (summary["verdict"], summary["waveform"]["lost_windows"]) == ("passed", 0)
    assert summary["worst"]["value"] == pytest.approx(0.0, abs=1e-6)


def make_gradient(profile, error, frequency=200.0):
    """Motion with a gradient: a tone of 20 um at 50 Hz times each place's share, and an error (m peak, each place)."""
    bands, time = make_bands(50.0, 20 * UM), times(4.0)
    extra = np.outer(np.cos(2 * np.pi * frequency * time), error)
    signals = make_signals(bands, np.reshape(profile, (3, 1)) * bands.envelope, extra=extra)
    return summary_of(bands, signals, {"profile": profile})


@pytest.mark.parametrize(("times_threshold", "found"), [(0.9, "passed"), (1.1, "failed")])
@pytest.mark.parametrize(("profile", "place"), [((1.0, 0.56, 1.44), 2), ((1.0, -0.3, 0.3), 1), ((1.0, 0.0, 2.0), 1)])
def test_a_spur_is_felt_as_it_moves_the_place_whatever_its_share(profile, place, times_threshold, found):
    error = times_threshold * hr.detection_threshold(200.0, "classic") * (np.arange(3) == place)
    summary = make_gradient(profile, error)
    figures = summary["waveform"]["places"][f"end_{place}"]
    assert summary["verdict"] == found
    assert figures["third_octaves"]["200 Hz"] == pytest.approx(0.2 * times_threshold, rel=0.03)
    scale = 20 * UM * max(abs(profile[place]), 0.1 * max(profile))
    assert figures["waveform_error"] == pytest.approx(error[place] / scale, rel=0.01)


@pytest.mark.parametrize("share", [0.0, 0.05])
@pytest.mark.parametrize(("error", "found"), [(0.009, "passed"), (0.011, "failed")])
def test_a_place_that_is_to_move_by_less_than_a_tenth_of_another_counts_as_a_tenth(share, error, found):
    """The tolerance is 10 %, of a tenth."""
    summary = make_gradient((1.0, share, 1.0), error * 20 * UM * np.array([0.0, 1.0, 0.0]), 50.0)
    assert summary["verdict"] == found
    assert summary["waveform"]["places"]["end_1"]["waveform_error"] == pytest.approx(10 * error, rel=1e-6)
    json.dumps(summary, allow_nan=False)
    assert (summary["bands"][0]["error_end_1"] is None) == (share < 0.05)


def test_above_500_hz_a_quiet_place_may_not_move_by_more_than_its_own_share():
    """Its share is a twentieth, which counts as a tenth: 1.5 % of the texture on top of 5 read 15 % of a tenth."""
    high = 100 * hr.detection_threshold(630.0, "classic")  # so that the texture is above what counts at least
    bands, profile = make_bands([50.0, 630.0], [20 * UM, high]), (1.0, 0.05, 1.0)
    extra = np.outer(0.015 * high * np.cos(2 * np.pi * 630.0 * times(4.0)), [0.0, 1.0, 0.0])
    motion = np.reshape(profile, (3, 1)) * bands.envelope
    figures = summary_of(bands, make_signals(bands, motion, extra=extra), {"profile": profile})["waveform"]["places"]
    assert figures["end_1"]["third_octaves"]["630 Hz"] == pytest.approx(0.15, rel=1e-6)


def test_a_lost_sample_of_friction_is_lost_alone(rng):
    """The mean friction of a touch is taken off, of what is known of it."""
    noise, bands = white(20, 400, rng, rms=0.01), make_bands(100.0, 0.0)
    for lost, windows, found in ((slice(0), 0, "passed"), (slice(15_000, 15_001), 1, "failed")):
        signals = make_signals(bands, 0.0, extra=(0.5 + noise)[:, None], position=0.0) | {"reference": noise}
        signals["motion"][lost] = np.nan
        summary = summary_of(bands, signals, {"unit": "N"}, settle=0.0)
        assert (summary["verdict"], summary["waveform"]["lost_windows"]) == (found, windows)


@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("N", 2 * np.pi * 250 / 0.64), ("m/s", 2 * np.pi * 250)])
@pytest.mark.parametrize(("share", "found"), [(0.009, "not judged"), (0.011, "failed")])
def test_a_texture_of_less_than_a_hundredth_of_what_can_be_felt_is_none(unit, scale, share, found):
    """A hundredth in amplitude of the safe threshold where that is least: at 250 Hz, also as a velocity."""
    tone = share * scale * hr.detection_threshold(250.0) * np.cos(2 * np.pi * 100 * times(4.0))
    bands = make_bands(100.0, 0.0)
    summary = summary_of(bands, make_signals(bands, 0.0) | {"reference": 1e-9 + tone}, {"unit": unit})
    assert summary["verdict"] == found
    assert summary["reason"].startswith("the texture is zero") == (found == "not judged")


@pytest.mark.parametrize(
    ("left", "gain", "flag", "found"),
    [
        (4.0, 1.0, 0, ("passed", "")),
        (1.6, 1.0, 0, ("not judged", "the run ended after 1.600 s of 4.000 s")),
        (1.6, 0.8, 0, ("failed", "")),
        (1.6, 1.0, Flag.OVERRUN, ("failed", "flags that are not allowed: overrun in 4000 samples")),
    ],
)
def test_a_run_that_was_cut_off_never_passes(left, gain, flag, found):
    bands = make_bands(100.0, 10 * UM)
    recorder = make_recorder(None, bands, settle=0.8)
    signals = make_signals(bands, gain * bands.envelope, duration=left)
    signals["flags"][:] = flag
    recorder.append(**signals)
    summary = recorder.finish().summary()
    assert (summary["verdict"], summary["reason"]) == found


def test_a_live_session_is_judged_however_short(tmp_path):
    """Of a scene of 60 s."""
    scene = hr.Scene(texture=hr.Grating(amplitude=10 * UM, frequency=100.0), duration=60.0, settle=0.5)
    with hr.Player(scene, paced=False) as player:
        player.play(scene.texture)
        player.record(tmp_path / "live.au")
        player.sleep(2.0)
        summary = player.end_recording().summary()
    assert (summary["verdict"], summary["reason"]) == ("passed", "")
    assert not any("ended after" in note for note in summary["notes"])
