"""The compiled entry: called from a thread of C while Python keeps its lock, it does what the Python path does."""

import copy
import ctypes
import pickle
import sys
import time
from dataclasses import replace

import numba
import numpy as np
import pytest
from numba import types
from synthetic import make_bands
from test_kernel import friction_controller, plate_controller
from waves import Own

import hapticrender as hr
from hapticrender.bands import Bands
from hapticrender.control.inverse import AdaptiveInverse
from hapticrender.control.supervisor import FADE_OUT
from hapticrender.jit import F8, kernel, pointer
from hapticrender.mathx import smoothstep
from hapticrender.plants.electroadhesion import SquareRoot
from hapticrender.plants.plate import PlateParameters
from hapticrender.protocols import Flag
from hapticrender.realtime_entry import GAIN_TIME, JUMP_TIME, LOG_MARGIN, LOG_TIME, SLOTS, TOUCH_FADE, RealtimeEntry
from hapticrender.realtime_kernel import ENTRY, HOLD, HORIZON, JUMP, MIDDLE_AT, swap
from hapticrender.renderers.shaped import Port, ShapedDriver
from hapticrender.sampled_texture import AHEAD, FADE, FRESH, SampledTexture, publish

RATE, BLOCK = 5000.0, 10
PLAIN = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint64, ctypes.c_void_p)
STREAM = (ctypes.c_ulong, ctypes.c_void_p, ctypes.c_ulong)
AUDIO = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p, *STREAM, ctypes.c_void_p)


def bands(wavenumber=0.0):
    frequency = [0.0] * 3 if wavenumber else [47.0, 130.0, 261.0]
    return make_bands(frequency, 5e-6, np.array([1.0, 2.0, 3.0]) * wavenumber, [0.0, 1.0, 2.0])


def controller(wanted=None, delay=BLOCK, block=BLOCK):
    return plate_controller(wanted or bands(), parameters=PlateParameters(), delay=delay, block=block)


def plain(entry, sensed):
    """Drive of the plain function, and what it returned."""
    drive = np.full((len(sensed), entry.controller.channels), np.nan)
    answer = PLAIN(entry.plain_address)(sensed.ctypes.data, drive.ctypes.data, len(sensed), entry.user_data)
    return drive, answer


@pytest.mark.parametrize("size", [{}, {"delay": 1, "block": 1}], ids=["blocks", "samples"])
def test_it_is_the_python_path_sample_for_sample(size, rng):
    """Noise in, in calls of one block and of many."""
    entry, twin = RealtimeEntry(controller(**size)), controller(**size)
    sensed, nothing = 1e-6 * rng.standard_normal((2000, 2)), np.zeros(2000)
    away = np.full(2000, np.nan)
    found = [plain(entry, sensed[n : n + BLOCK])[0] for n in range(0, 500, BLOCK)] + [plain(entry, sensed[500:])[0]]
    np.testing.assert_array_equal(np.concatenate(found), twin.run(sensed, away, nothing)[0])
    assert entry.samples == 2000
    assert entry.flags == Flag(0)


def followed(updates, n):
    """Position and touch (0..1) of n samples from updates (sample, position, velocity), obviously."""
    positions, touch, update = np.empty(n), np.empty(n), None
    last, pace, offset, first, grown = np.nan, 0.0, 0.0, 0.0, 0.0
    kept = np.exp(-1.0 / (JUMP_TIME * RATE))
    for i in range(n):
        for new in updates:
            if new[0] == i:
                update, jump = new, last + pace - new[1]
                offset = first = jump if abs(jump) < JUMP else 0.0
        age = (i - update[0]) / RATE
        positions[i] = update[1] + min(age, HORIZON) * update[2] + offset
        first *= kept
        offset = first + kept * (offset - first)
        if np.isfinite(positions[i]):
            pace = positions[i] - last if abs(positions[i] - last) < JUMP else 0.0
            last = positions[i]
        there = np.isfinite(positions[i]) and age < HOLD
        grown = min(max(grown + (1 if there else -1) / (TOUCH_FADE * RATE), 0.0), 1.0)
        touch[i] = smoothstep(np.array(grown))
    return positions, touch


def played(entry, updates, sensed):
    """Drive of an entry whose finger is updated on the way."""
    ends = [*(update[0] for update in updates[1:]), len(sensed)]
    found = []
    for (start, place, speed), stop in zip(updates, ends, strict=True):
        entry.finger(place, speed)
        found.append(plain(entry, sensed[start:stop])[0])
    return np.concatenate(found)


@pytest.mark.parametrize("friction", [False, True])
def test_the_finger_is_extrapolated_between_updates(friction, rng):
    """Its position goes on at its speed, and stops after `HORIZON` without an update; corrections are spread."""
    wanted = bands(wavenumber=500.0)
    make = (lambda: friction_controller(wanted)) if friction else (lambda: controller(wanted))
    entry, twin = RealtimeEntry(make()), make()
    sensed = 1e-7 * rng.standard_normal((1500, 2))
    updates = [(0, -0.01, 0.05), (200, -0.0078, 0.06), (500, 0.002, 0.1)]
    position, _ = followed(updates, 1500)
    expected = twin.run(sensed, position, np.zeros(1500))[0]
    assert abs(expected).max() > 0
    tolerance = 1e-10 * abs(expected).max()  # positions round once or twice
    np.testing.assert_allclose(played(entry, updates, sensed), expected, rtol=0, atol=tolerance)
    jumps = abs(np.diff(position))
    assert jumps[199] < 2e-5 < 1e-3 < jumps[499]  # 0.2 mm off are spread, 5 mm are another place


@pytest.mark.parametrize("straight", [False, True])
def test_the_drive_of_a_screen_is_the_peak_of_its_carrier(straight, rng):
    """By the square root that is before a driver; a larger bias is reached within `FADE`; at rest it fades to zero."""
    wanted = bands(wavenumber=500.0)
    roots = [SquareRoot(bias=bias, floor=bias / 20, gain=2e4, straight=straight) for bias in (0.4, 0.9, 0.2)]
    root = ShapedDriver(Port(RATE, BLOCK, BLOCK, 1, 2), roots[0])
    entry, twin = (RealtimeEntry(friction_controller(wanted), converter=each) for each in (root, None))
    sensed, n = 1e-7 * rng.standard_normal((1000, 2)), round(FADE * RATE)
    for each in (entry, twin):
        each.finger(-0.01, 0.05)
    drive, _ = plain(twin, abs(sensed))
    assert abs(drive).max() > 0.0
    np.testing.assert_allclose(plain(entry, sensed[:500])[0], roots[0](drive[:500]), rtol=1e-12)
    root.reshape(roots[1])
    rising = plain(entry, sensed[500 : 500 + n])[0]
    assert (rising > roots[0](drive[500 : 500 + n])).all()
    assert (rising[: n // 3] < roots[1](drive[500 : 500 + n // 3])).all()
    root.reshape(roots[2])
    np.testing.assert_allclose(plain(entry, sensed[500 + n :])[0], roots[1](drive[500 + n :]), rtol=1e-12)
    entry.silence()
    fading, rest = np.split(plain(entry, sensed[:20])[0], [round(FADE_OUT * RATE)])
    np.testing.assert_allclose(fading, roots[1](0.0) * (1 - np.arange(1, 11)[:, None] / 10), rtol=1e-12, atol=1e-15)
    assert not rest.any()


def wave(spatial, amplitude=1e-5):
    """A sine of 130 Hz in time, or of 3 mm along the surface."""
    turns = (lambda time, position: position / 3e-3) if spatial else (lambda time, position: 130.0 * time)
    return Own(lambda *where: amplitude * np.sin(2 * np.pi * turns(*where)), spatial)


def designed(spatial, whole):
    """Law of a whole waveform, or by bands; in drive of any size, as a converter's steps would magnify rounding."""
    if whole:
        model = replace(PlateParameters().device_model(RATE, 1), drive_step=0.0)
        return AdaptiveInverse().design(model, Bands.none(spatial=False))
    made = controller(replace(bands(wavenumber=500.0 if spatial else 0.0), envelope=None))
    made.state["p"]["drive_step"] = 0.0
    return made


@pytest.mark.parametrize("whole", [True, False], ids=["whole", "bands"])
@pytest.mark.parametrize("spatial", [False, True], ids=["in time", "along the surface"])
def test_a_texture_fades_in_and_another_fades_over_it(spatial, whole, rng):
    """Read ahead as the law needs it: in time, or where the finger will be at its last speed."""
    entry, twin, n = RealtimeEntry(designed(spatial, whole)), designed(spatial, whole), 1500
    sensed, change = 1e-7 * rng.standard_normal((n, 2)), 700
    updates = [(0, -0.004, 0.05)]
    first, second = wave(spatial), wave(not spatial, 2e-5)
    entry.play(SampledTexture(first, RATE))
    entry.finger(*updates[0][1:])
    drive = [plain(entry, sensed[:change])[0]]
    entry.play(SampledTexture(second, RATE))
    drive.append(plain(entry, sensed[change:])[0])
    position, touch = followed(updates, n)
    ahead, now = entry.ahead, np.arange(n)
    lead, input_, there, kept = 0.0, 0.0, position.copy(), np.exp(-1.0 / (JUMP_TIME * RATE))
    for i in now:
        there[i] += lead
        wanted = 0.05 * ahead / RATE if i / RATE < HORIZON else 0.0
        input_ = wanted + kept * (input_ - wanted)
        lead = input_ + kept * (lead - input_)
    expected = np.zeros(n)
    for texture, begun in ((first, ahead), (second, change + ahead)):
        time = (now + ahead - begun) / RATE
        value = texture.waveform(time, there) * (touch if texture.spatial else time >= 0)
        weight = smoothstep(time / (round(FADE * RATE) / RATE))
        expected = (1 - weight) * expected + weight * value
    target = twin.run(sensed, position, expected)[0]
    assert abs(target).max() > 1e-3
    # cubic interpolation of 3 mm in steps of 2 um: (3/128) (2 pi/1500)^4 = 7e-12
    np.testing.assert_allclose(np.concatenate(drive), target, rtol=0, atol=1e-9 * abs(target).max())
    log = entry.log(0)
    assert log["first"] == 0
    np.testing.assert_array_equal(log["sensed"], sensed)
    block = entry.block  # in whose samples the drive of the block before plays
    np.testing.assert_array_equal(log["drive"], np.concatenate([np.zeros((block, 2)), *drive])[:-block])
    settled = slice(round(FADE * RATE) + ahead + round(TOUCH_FADE * RATE), change)
    expected = first.waveform((now - ahead) / RATE, position)
    np.testing.assert_allclose(log["reference"][settled], expected[settled], rtol=0, atol=1e-14)


def test_what_lies_along_the_surface_fades_out_without_updates_and_what_lies_in_time_goes_on():
    n = round((HOLD + 0.2) * RATE)
    for texture, goes_on in ((wave(False), True), (wave(True), False)):
        entry = RealtimeEntry(designed(False, True))
        entry.play(SampledTexture(texture, RATE))
        entry.finger(0.0002, 0.0)
        plain(entry, np.zeros((n, 2)))
        log = entry.log(0)["reference"]
        assert abs(log[round(0.1 * RATE) : round(HOLD * RATE)]).max() > 3e-6
        assert (abs(log[-100:]).max() > 3e-6) == goes_on
        assert goes_on or abs(log[-100:]).max() == 0.0


def test_the_log_leaves_out_what_may_be_written_while_it_is_read():
    entry, kept = RealtimeEntry(designed(False, True)), (LOG_TIME - LOG_MARGIN) * RATE
    for _ in range(round(1.5 * LOG_TIME * RATE / 100)):
        plain(entry, np.zeros((100, 2)))
    assert kept - 100 < entry.samples - entry.log(0)["first"] <= kept
    assert entry.log(entry.samples - 10)["first"] == entry.samples - 10


def test_a_program_that_hangs_fades_a_texture_in_time_out_and_back_without_a_step():
    """It is 2 s ahead: what fades, and is 0, is flagged; it comes back in its own time."""
    entry, texture = RealtimeEntry(designed(False, True)), SampledTexture(wave(False), RATE)
    entry.play(texture)
    log = []
    for seconds, filled in ((AHEAD - FADE, False), (0.1, True), (0.2, False), (AHEAD, True), (0.2, False)):
        start = entry.samples
        for _ in range(round(seconds * RATE / 100)):  # the log holds 2 s
            start = entry.samples
            plain(entry, np.zeros((100, 2)))
            log.append(entry.log(start))
        if filled:
            entry.fill()
    reference, flags = (np.concatenate([each[name] for each in log]) for name in ("reference", "flags"))
    late = flags & Flag.OVERRUN > 0
    silent = slice(round((AHEAD + 0.01) * RATE), round((AHEAD - FADE + 0.1) * RATE))
    assert not late[: round((AHEAD - FADE) * RATE) - 1].any()
    assert late[silent].all()
    assert not reference[silent].any()
    whole = slice(silent.stop + entry.ahead + round(FADE * RATE) + 1, silent.stop + round(0.2 * RATE))
    since = (np.arange(len(reference)) - entry.ahead) / RATE
    expected = wave(False).waveform(since, since)
    np.testing.assert_allclose(reference[whole], expected[whole], rtol=0, atol=1e-14)
    assert not late[whole].any()
    # 1.5 of its size in a fade, and its own slope
    steepest = abs(expected).max() * 1.5 / (FADE * RATE) + abs(np.diff(expected)).max()
    assert abs(np.diff(reference)).max() < steepest


def test_a_gain_is_reached_without_a_step():
    entry = RealtimeEntry(designed(False, True))
    entry.play(SampledTexture(wave(False), RATE))
    plain(entry, np.zeros((1000, 2)))
    entry.set_gain(3.0)
    plain(entry, np.zeros((1000, 2)))
    log = entry.log(0)["reference"]
    smooth = 3.0 - 2.0 * np.exp(-np.arange(1, 1001) / (GAIN_TIME * RATE))
    plain_wave = wave(False).waveform((np.arange(2000) - entry.ahead) / RATE, 0.0)
    begin = 1000 + entry.ahead
    np.testing.assert_allclose(log[begin:], plain_wave[begin:] * smooth[: 1000 - entry.ahead], rtol=0, atol=1e-14)


def test_textures_that_have_faded_out_are_let_go():
    entry = RealtimeEntry(designed(False, True))
    for k in range(20):
        entry.play(SampledTexture(wave(False, 1e-6 * (k + 1)), RATE))
        plain(entry, np.zeros((500, 2)))
    assert len(entry._textures) <= 5
    assert abs(entry.log(9900)["reference"]).max() == pytest.approx(20e-6, rel=0.02)


@pytest.mark.parametrize("scales", [(2e-4, 0.25), ([2e-4, 3e-4], [0.25, 2.0])])
def test_the_audio_callback_scales_full_scale_to_metres_and_amperes(scales, rng):
    """Floats of 2e-4 m at full scale in, 1.0 for 4 A out; or of other units in every channel."""
    units, drive_scale = np.array(scales[0]), np.array(scales[1])
    entry, twin = RealtimeEntry(controller(), sensed_scale=scales[0], drive_scale=scales[1]), controller()
    floats = rng.standard_normal((400, 2)).astype(np.float32) * np.float32(0.01)
    given = np.full((400, 2), np.nan, np.float32)
    assert AUDIO(entry.address)(floats.ctypes.data, given.ctypes.data, 400, None, 0, entry.user_data) == 0
    expected = drive_scale * twin.run(units * floats.astype(float), np.full(400, np.nan), np.zeros(400))[0]
    np.testing.assert_array_equal(given, expected.astype(np.float32))


def test_what_does_not_fit_gives_zeros():
    """A broken block, a missing buffer; and samples that the audio library has lost are flagged."""
    entry = RealtimeEntry(controller())
    floats, given = np.ones((2 * BLOCK, 2), np.float32), np.full((2 * BLOCK, 2), np.nan, np.float32)
    audio = AUDIO(entry.address)
    assert audio(floats.ctypes.data, given.ctypes.data, BLOCK + 1, None, 0, entry.user_data) == 2
    assert (given[: BLOCK + 1] == 0).all()
    given[:] = np.nan
    assert audio(None, given.ctypes.data, BLOCK, None, 0, entry.user_data) == 2
    assert (given[:BLOCK] == 0).all()
    assert audio(floats.ctypes.data, None, BLOCK, None, 0, entry.user_data) == 2
    assert plain(entry, np.zeros((BLOCK - 1, 2)))[1] == -1
    assert entry.refused == 4
    assert entry.samples == 0
    assert audio(np.zeros((BLOCK, 2), np.float32).ctypes.data, given.ctypes.data, BLOCK, None, 4, entry.user_data) == 0
    assert entry.flags == Flag.OVERRUN


def test_silence_is_zero_drive(rng):
    entry = RealtimeEntry(controller())
    sensed = 1e-6 * rng.standard_normal((300, 2))
    assert abs(plain(entry, sensed)[0]).max() > 0
    entry.silence()
    assert (plain(entry, sensed)[0] == 0).all()
    assert entry.samples == 600


@pytest.mark.skipif(sys.platform == "win32", reason="threads are made with pthread_create")
def test_a_thread_of_c_plays_on_while_python_keeps_its_lock(rng):
    """Python holds its lock in a loop that never gives it up; a thread that never knew Python fills every block."""
    entry, twin = RealtimeEntry(controller()), controller()
    sensed, drive = 1e-6 * rng.standard_normal((20_000, 2)), np.zeros((20_000, 2))
    process, record = PLAIN(entry.plain_address), entry.user_data
    into, out = int(sensed.ctypes.data), int(drive.ctypes.data)

    @numba.cfunc(types.uintp(types.uintp))
    def thread(job):
        for start in range(0, 20_000, BLOCK):
            process(into + 16 * start, out + 16 * start, BLOCK, record)
        return job

    library, handle = ctypes.PyDLL(None), ctypes.c_ulong()  # PyDLL: its calls keep the lock, too
    last, before = 0, sys.getswitchinterval()
    sys.setswitchinterval(1000.0)  # s: nobody else gets the lock
    try:
        function = ctypes.c_void_p(thread.address)
        assert library.pthread_create(ctypes.byref(handle), None, function, None) == 0
        end = time.monotonic() + 60
        while last < 20_000 and time.monotonic() < end:
            last = entry.samples
    finally:
        sys.setswitchinterval(before)
        library.pthread_join(handle, None)
    assert last == 20_000
    expected = twin.run(sensed, np.full(20_000, np.nan), np.zeros(20_000))[0]
    np.testing.assert_array_equal(drive, expected)


@kernel
def write(entry, slots, width, rounds):
    """Fill slot after slot with one number and hand it over."""
    table, back = numba.carray(pointer(slots, F8), (SLOTS, width)), 0
    for i in range(1, rounds + 1):
        for j in range(width):
            table[back, j] = i
        back = publish(entry + MIDDLE_AT, back)
    return 0


@kernel
def read(entry, slots, width, rounds):
    """Take slot after slot up; returns how many were torn, and how many older than the one before."""
    table, front, torn, backwards, last = numba.carray(pointer(slots, F8), (SLOTS, width)), 2, 0, 0, 0.0
    while last < rounds:
        if numba.carray(pointer(entry + MIDDLE_AT, types.int64), 1)[0] & FRESH:
            front = swap(entry + MIDDLE_AT, front) & (FRESH - 1)
        first = table[front, 0]
        for j in range(width):
            torn += table[front, j] != first
        backwards += first < last
        last = first
    return torn, backwards


def test_slots_change_hands_whole():
    """A writer and a reader at full speed: no slot is ever seen half written, and what is seen never goes back."""
    entry, table, rounds = np.zeros(1, ENTRY), np.zeros((SLOTS, 64)), 200_000
    entry["middle"] = 1
    arguments = (entry.ctypes.data, table.ctypes.data, 64)
    write(*arguments, 0)
    read(*arguments, 0)  # compiled
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(2) as pool:
        found = pool.submit(read, *arguments, rounds)
        pool.submit(write, *arguments, rounds)
        assert found.result(60) == (0, 0)


def test_what_holds_addresses_or_a_device_is_not_copied():
    """A copy would read and write the memory of the first, or play on its device."""
    bank, scenes = controller(), hr.builtin_scenes()
    texture = SampledTexture(hr.Grating(frequency=72.0, amplitude=1e-5), 5000.0)
    own = [hr.prepare(scenes[name], compiled=False).controller() for name in ("grating-72", "one-texture-hybrid")]
    for each in (bank, RealtimeEntry(bank), texture, hr.Player(), *own):
        for duplicate in (copy.copy, copy.deepcopy, pickle.dumps):
            with pytest.raises(TypeError, match=rf"^{type(each).__name__}: cannot be copied or pickled"):
                duplicate(each)
