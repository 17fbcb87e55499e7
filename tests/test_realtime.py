"""The compiled entry: called from a thread of C while Python keeps its lock, it does what the Python path does."""

import ctypes
import sys
import time
from dataclasses import replace

import numba
import numpy as np
import pytest
from numba import types
from test_kernel import friction_controller, plate_controller

from hapticrender.bands import Bands
from hapticrender.control.inverse import AdaptiveInverse
from hapticrender.jit import F8, kernel, pointer
from hapticrender.plants.plate import PlateParameters
from hapticrender.protocols import Flag
from hapticrender.realtime import ENTRY, FRESH, HORIZON, MIDDLE_AT, SLOTS, RealtimeEntry, publish, swap

RATE, BLOCK = 5000.0, 10
PLAIN = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint64, ctypes.c_void_p)
STREAM = (ctypes.c_ulong, ctypes.c_void_p, ctypes.c_ulong)
AUDIO = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p, *STREAM, ctypes.c_void_p)


def bands(amplitude=5e-6, wavenumber=0.0):
    moves = wavenumber > 0
    return Bands(
        frequency=np.where(moves, 0.0, [47.0, 130.0, 261.0]),
        wavenumber=np.where(moves, [1.0, 2.0, 3.0], 0.0) * wavenumber,
        phase=[0.0, 1.0, 2.0],
        envelope=np.full(3, amplitude + 0j),
    )


def controller(wanted=None, delay=BLOCK, block=BLOCK):
    return plate_controller(wanted or bands(), parameters=PlateParameters(), delay=delay, block=block)


def plain(entry, sensed):
    """Drive of the plain function, and what it returned."""
    drive = np.full((len(sensed), entry.controller.channels), np.nan)
    answer = PLAIN(entry.plain_address)(sensed.ctypes.data, drive.ctypes.data, len(sensed), entry.user_data)
    return drive, answer


@pytest.mark.parametrize("size", [{}, {"delay": 1, "block": 1}], ids=["blocks", "samples"])
def test_it_is_the_python_path_sample_for_sample(size, rng):
    """Noise in, in calls of one block and of many; other targets on the way."""
    entry, twin = RealtimeEntry(controller(**size)), controller(**size)
    sensed, nothing = 1e-6 * rng.standard_normal((2000, 2)), np.zeros(2000)
    away = np.full(2000, np.nan)
    found = [plain(entry, sensed[n : n + BLOCK])[0] for n in range(0, 500, BLOCK)] + [plain(entry, sensed[500:1000])[0]]
    entry.send(bands(amplitude=9e-6))
    found.append(plain(entry, sensed[1000:])[0])
    expected = [twin.run(sensed[:1000], away[:1000], nothing[:1000])[0]]
    twin.send(bands(amplitude=9e-6))
    expected.append(twin.run(sensed[1000:], away[1000:], nothing[1000:])[0])
    np.testing.assert_array_equal(np.concatenate(found), np.concatenate(expected))
    assert entry.samples == 2000
    assert entry.flags == Flag(0)


@pytest.mark.parametrize("friction", [False, True])
def test_the_finger_is_extrapolated_between_updates(friction, rng):
    """Its position goes on at its speed, and stops after `HORIZON` without an update; on any device."""
    wanted = bands(wavenumber=500.0)
    make = (lambda: friction_controller(wanted)) if friction else (lambda: controller(wanted))
    entry, twin = RealtimeEntry(make()), make()
    sensed, position = 1e-7 * rng.standard_normal((1500, 2)), np.empty(1500)
    found = []
    for start, place, speed in ((0, -0.01, 0.05), (200, -0.0078, 0.06), (500, 0.002, 0.1)):
        stop = {0: 200, 200: 500, 500: 1500}[start]
        entry.finger(place, speed)
        position[start:stop] = place + np.minimum(np.arange(stop - start) / RATE, HORIZON) * speed
        found.append(plain(entry, sensed[start:stop])[0])
    expected = twin.run(sensed, position, np.zeros(1500))[0]
    assert abs(expected).max() > 0
    tolerance = 1e-10 * abs(expected).max()  # positions round once or twice
    np.testing.assert_allclose(np.concatenate(found), expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("spatial", [False, True])
def test_a_recorded_waveform_is_played_in_a_loop(spatial, rng):
    """Over time, or over the position; linear between its samples, to a rounding of the place in it."""
    wanted = replace(bands(wavenumber=500.0 if spatial else 0.0), envelope=None)
    table, period = 1e-5 * rng.standard_normal(256), 0.01 if spatial else 0.1
    entry, twin = RealtimeEntry(controller(wanted), waveform=table, period=period, spatial=spatial), controller(wanted)
    n = 1500
    now = np.arange(n) / RATE
    entry.finger(-0.004, 0.05)
    position = -0.004 + 0.05 * np.minimum(now, HORIZON)
    at = np.mod((position if spatial else now) / period, 1.0) * 256
    values = np.interp(at, np.arange(257), np.append(table, table[0]))
    expected = twin.run(np.zeros((n, 2)), position, values)[0]
    assert abs(expected).max() > 0
    np.testing.assert_allclose(plain(entry, np.zeros((n, 2)))[0], expected, rtol=0, atol=1e-9 * abs(expected).max())


@pytest.mark.parametrize("spatial", [False, True])
def test_a_whole_waveform_is_read_ahead(spatial):
    """By the law's look-ahead in time, or where the finger will be then at the speed it is told to have."""
    period, speed = 0.05, 0.05
    table = 1e-5 * np.sin(2 * np.pi * np.arange(256) / 256)

    def designed():
        return AdaptiveInverse().design(PlateParameters().device_model(RATE, 1), Bands.none(spatial=spatial))

    entry, twin = RealtimeEntry(designed(), waveform=table, period=period, spatial=spatial), designed()
    now = np.arange(100) / RATE
    entry.finger(0.0, speed)
    at = (now + twin.lookahead / RATE) * (speed if spatial else 1.0) / period
    values = np.interp(np.mod(at, 1.0) * 256, np.arange(257), np.append(table, table[0]))
    expected = twin.run(np.zeros((100, 2)), speed * now, values)[0]
    assert abs(expected).max() > 0
    np.testing.assert_allclose(plain(entry, np.zeros((100, 2)))[0], expected, rtol=0, atol=1e-9)


def test_the_audio_callback_scales_full_scale_to_metres_and_amperes(rng):
    """Floats of 2e-4 m at full scale in, 1.0 for 4 A out."""
    entry, twin = RealtimeEntry(controller(), sensed_scale=2e-4, drive_scale=0.25), controller()
    floats = rng.standard_normal((400, 2)).astype(np.float32) * np.float32(0.01)
    given = np.full((400, 2), np.nan, np.float32)
    assert AUDIO(entry.address)(floats.ctypes.data, given.ctypes.data, 400, None, 0, entry.user_data) == 0
    expected = 0.25 * twin.run(2e-4 * floats.astype(float), np.full(400, np.nan), np.zeros(400))[0]
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


def test_silence_is_zero_drive_and_ends_where_it_should(rng):
    entry = RealtimeEntry(controller())
    sensed = 1e-6 * rng.standard_normal((300, 2))
    assert abs(plain(entry, sensed)[0]).max() > 0
    entry.silence()
    assert (plain(entry, sensed)[0] == 0).all()
    entry.silence(quiet=False)
    assert abs(plain(entry, sensed)[0]).max() > 0
    assert entry.samples == 900


def test_a_sensor_fault_is_flagged():
    entry = RealtimeEntry(controller())
    sensed = np.zeros((BLOCK, 2))
    sensed[3, 1] = np.nan
    drive, answer = plain(entry, sensed)
    assert answer == Flag.NONFINITE == entry.flags
    assert np.isfinite(drive).all()


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
        back = publish(entry, back)
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


def test_what_it_refuses():
    with pytest.raises(TypeError, match="controller of type object: must have a compiled step"):
        RealtimeEntry(object())
    entry, ridges = RealtimeEntry(controller()), RealtimeEntry(controller(bands(wavenumber=500.0)))
    entry.send(replace(bands(), frequency=[50.0, 140.0, 300.0]))
    for taker, wanted, message in (
        (entry, Bands(frequency=[50.0], wavenumber=[0.0], phase=[0.0], envelope=[1e-6]), "1 bands: must be 3"),
        (entry, replace(bands(), envelope=None), "the targets are a waveform"),
        (entry, replace(bands(), frequency=[48.0, 130.0, 261.0]), "least spacing of 82: must be >= 83"),
        (entry, bands(wavenumber=500.0), "must follow the finger as designed for"),
        (entry, replace(bands(), frequency=[50.0, 140.0, 4900.0]), "carrier of 4900 Hz: must be <= 1000 Hz"),
        (ridges, replace(bands(wavenumber=500.0), wavenumber=[500.0, 510.0, 1500.0]), "per metre of 10: must be >="),
    ):
        with pytest.raises(ValueError, match=message):
            taker.send(wanted)
    with pytest.raises(ValueError, match="must be finite"):
        entry.finger(0.0, np.nan)
    with pytest.raises(ValueError, match="waveform: must be given for targets that are a waveform"):
        RealtimeEntry(controller(replace(bands(), envelope=None)))
