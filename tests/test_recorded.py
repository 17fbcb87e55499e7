"""Recorded textures: samples and sound files."""

import os

import numpy as np
import pytest
import soundfile

from hapticrender.errors import SceneError
from hapticrender.touch import recorded
from hapticrender.touch.recorded import Recorded


def tone(frequency, rate, seconds=2.0):
    return np.cos(2 * np.pi * frequency * np.arange(round(seconds * rate)) / rate)


@pytest.fixture
def write(tmp_path):
    def write(samples, rate=8000, name="texture.wav", subtype="DOUBLE"):
        soundfile.write(tmp_path / name, samples, rate, subtype=subtype)
        return tmp_path / name

    return write


@pytest.mark.parametrize("rate", [1000, 44100])
def test_a_tone_in_time_comes_back_at_any_file_rate(write, rate):
    texture = Recorded(file=write(0.25 * tone(140.0, rate), rate), gain=4e-6)
    time = np.arange(0.3, 1.7, 1 / 5000)
    played = texture.waveform(time, np.full(time.size, np.nan))
    np.testing.assert_allclose(played, 1e-6 * np.cos(2 * np.pi * 140.0 * time), atol=2e-3 * 1e-6)


@pytest.mark.parametrize("speed", [0.02, 0.11])
def test_a_spatial_recording_is_read_at_the_position_at_any_speed(write, speed):
    """Recorded at 50 mm/s a tone of 100 Hz is a wavelength of 0.5 mm."""
    texture = Recorded(file=write(tone(100.0, 8000)), gain=10e-6, speed=0.05, carriers=8)
    time = np.arange(0, 0.3, 1 / 5000)
    position = -0.01 + speed * time
    expected = 10e-6 * np.cos(2 * np.pi * (position + 0.05 * (2.0 - 1 / 8000) / 2) / 0.5e-3)
    np.testing.assert_allclose(texture.waveform(time, position), expected, atol=2e-3 * 10e-6)
    bands = texture.bands(5000.0)
    assert bands.wavenumber == pytest.approx([2000.0], rel=1e-3)
    assert bands.instantaneous_frequency(np.array([speed]))[0] == pytest.approx([speed / 0.5e-3], rel=1e-3)


@pytest.mark.parametrize("frequency", [30.0, 47.0, 100.0, 250.0])
@pytest.mark.parametrize("phase", [0.0, np.pi / 4, np.pi / 2], ids=["sine", "between", "cosine"])
@pytest.mark.parametrize("rate", [1000.0, 8000.0])
def test_a_tone_has_the_amplitude_that_is_asked_for_wherever_its_recording_begins(frequency, phase, rate):
    """At 1 kHz none of the samples of 250 Hz, 45 degrees off, is beyond 0.71 of the peak; a constant is no part."""
    samples = np.sin(2 * np.pi * frequency * np.arange(round(2 * rate)) / rate + phase) + 0.3
    texture = Recorded(samples=samples, rate=rate, amplitude=5e-6)
    played = texture.waveform(np.arange(0.5, 1.5, 1e-5), np.full(100_000, np.nan))
    assert abs(played).max() == pytest.approx(5e-6, rel=0.01)


def test_a_knock_at_the_start_of_a_recording_is_its_peak(rng):
    samples = 0.01 * rng.standard_normal(8000)
    samples[80:120] += np.sin(2 * np.pi * 200 * np.arange(40) / 8000)
    texture = Recorded(samples=samples, rate=8000.0, amplitude=5e-6)
    assert abs(texture.curve.values).max() <= 5e-6 * (1 + 1e-9)


def test_beyond_its_ends_a_recording_runs_back_without_a_jump(write, rng):
    texture = Recorded(file=write(rng.uniform(-1, 1, 4001)), amplitude=10e-6)
    length = texture.curve.length
    assert length == pytest.approx(0.5, rel=1e-12)
    time = np.arange(0, 0.4, 1e-4)
    for end in (0.0, length):
        before, after = (texture.waveform(end + sign * time, time) for sign in (-1, 1))
        np.testing.assert_allclose(before, after, atol=1e-9 * 10e-6)
    np.testing.assert_allclose(texture.waveform(time + 2 * length, time), texture.waveform(time, time), atol=1e-15)


def test_carriers_are_the_strongest_peaks_apart(write, rng):
    rate, present = 8000, {47.0: 0.5, 60.0: 0.3, 143.0: 1.0, 305.0: 0.2, 390.0: 0.7}
    samples = sum(weight * tone(frequency, rate, 4.0) for frequency, weight in present.items()) / 4
    samples += 1e-4 * rng.standard_normal(samples.size)
    file = write(samples)
    all_clear = Recorded(file=file, amplitude=1e-6, carriers=8).bands(5000.0)
    assert all_clear.frequency == pytest.approx([47.0, 143.0, 305.0, 390.0], abs=0.2)  # 60 Hz is within 40 of 47
    assert Recorded(file=file, amplitude=1e-6, carriers=2).bands(5000.0).frequency == pytest.approx(
        [143.0, 390.0], abs=0.2
    )
    closer = Recorded(file=file, amplitude=1e-6, carriers=8, spacing=12.0).bands(5000.0)
    assert closer.frequency == pytest.approx(sorted(present), abs=0.2)
    assert Recorded(file=file, amplitude=1e-6, carriers=8).bands(500.0).frequency.max() < 250.0


TINY, HALF = np.zeros(100), 0.5 * np.cos(2 * np.pi * 100.0 * np.arange(16_000) / 8000)
BAD = [  # samples, rate, fields, message; headers of a few bytes would make gigabytes, so that all are bounded together
    (np.array([0.0, np.nan, 0.0]), 8000, {}, r"file = .*texture.wav.*: sample 1 of channel 0 = nan: must be a finite"),
    (np.zeros(4000), 8000, {}, r"amplitude = 1e-06 m: nothing to scale between 20 and 1000 Hz"),
    (np.ones(400), 8000, {"passband": (5000.0, 6000.0)}, r"passband = .* Hz: must start < 4000 Hz"),
    (HALF, 8000, {"gain": 3.0}, r"gain = 3 m per unit of the file makes a peak of 1\.5\d? m: must be <= 0.01 m"),
    (HALF, 8000, {"gain": 0.021}, "gain = 0.021 m per unit"),  # of half scale
    (TINY, 2_000_000_000, {}, "has a rate of 2000000000 Hz: must be"),
    (np.zeros((100, 1000), np.int16), 48_000, {}, "1000 channels: must be <= 65536 samples"),
    (np.zeros(3_000_000), 1000, {"passband": (20.0, 400.0)}, "take 57.* points: must be <= 16777216"),
    (TINY + 1e300, 8000, {}, "must be a finite number within 1e\\+06 times full scale"),
]


@pytest.mark.parametrize(("samples", "rate", "fields", "message"), BAD, ids=range(len(BAD)))
def test_bad_recordings_are_refused(write, monkeypatch, samples, rate, fields, message):
    monkeypatch.setattr(recorded, "MOST_SAMPLES", 1 << 16 if samples.ndim == 2 else 1 << 26)
    scale = {} if "gain" in fields else {"amplitude": 1e-6}
    file = write(samples, rate, subtype="DOUBLE" if samples.dtype == float else "PCM_16")
    with pytest.raises(SceneError, match=message):
        Recorded(file=file, **scale, **fields).check()


def test_a_gain_is_metres_per_full_scale_not_a_factor(write):
    """A tone of half scale: 0.02 m per full scale make 0.01 m, the most; a factor of 3 would be 1.5 m."""
    Recorded(file=write(HALF), gain=0.019).check()


SOUNDS = {"b.wav": "DOUBLE", "a.rf64": "FLOAT", "a.aiff": "PCM_16", "a.flac": "PCM_16", "a.ogg": "VORBIS"}


@pytest.mark.parametrize("name", SOUNDS)
def test_a_sound_file_cut_off_in_the_middle_is_refused(tmp_path, rng, name):
    file = tmp_path / name
    kind = {".rf64": "RF64"}.get(file.suffix)
    soundfile.write(file, rng.uniform(-0.5, 0.5, 20000), 8000, subtype=SOUNDS[name], format=kind)
    Recorded(file=file, amplitude=1e-6).check()
    os.truncate(file, file.stat().st_size // 2)
    with pytest.raises(
        SceneError, match=rf"^file = .*{name}.*: (ends after \S+ % of what .*: must be whole|must be|has 0)"
    ):
        Recorded(file=file, amplitude=1e-6).check()


def test_a_sound_file_of_a_killed_recorder_or_of_a_stream_is_read(write):
    """Its header was written before the length was known: 0, or as much as fits."""
    file = write(tone(100.0, 8000))
    whole = file.read_bytes()
    at = whole.index(b"data") + 4
    for unknown in (b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f"):
        riff = b"\x08\0\0\0" if unknown[0] == 0 else unknown
        file.write_bytes(whole[:4] + riff + whole[8:at] + unknown + whole[at + 4 :])
        assert Recorded(file=file, amplitude=1e-6).curve.length == pytest.approx(2.0, abs=1e-3)


def test_what_is_no_sound_file_is_refused(tmp_path):
    (tmp_path / "text.wav").write_text("no sound at all")
    for name, message in [("text.wav", "readable"), ("absent.wav", "existing"), (".", "existing")]:
        with pytest.raises(SceneError, match=f"^file = .*: must be an? {message} sound file"):
            Recorded(file=tmp_path / name, amplitude=1e-6).check()
