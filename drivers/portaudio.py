"""PortAudio's C interface (portaudio.h): the structs and functions that a stream with a compiled callback needs.

The library is the system's (``libportaudio``), or that which the package sounddevice brings on Windows and macOS.
"""

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import py_object, pythonapi
from ctypes.util import find_library
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.metadata import PackageNotFoundError, files
from typing import Any

import cffi

from hapticrender.errors import DeviceNotFound, DriverError

LEAST_VERSION = 0x130600  # 19.6.0: the first whose Pa_GetVersion returns more than "19"
FLOAT32 = 0x00000001  # paFloat32, interleaved
ANTICIPATED_ERRORS = {-9985: "it is in use by another program, or does not exist any more"}  # paDeviceUnavailable
HOST_ERROR = -9999  # paUnanticipatedHostError: PaHostErrorInfo has the details
CLOSE_TIMEOUT = 8.0  # s: longest wait for a stream to close, also on a busy machine
ADVICE = "restart the program"
INSTALL = (
    "to get it: Debian and Ubuntu: apt install libportaudio2; Fedora: dnf install portaudio; "
    'macOS and Windows: pip install "hapticrender[audio]"'
)


FFI = cffi.FFI()
FFI.cdef("""
    typedef struct {
        int structVersion; const char *name; int hostApi, maxInputChannels, maxOutputChannels;
        double defaultLowInputLatency, defaultLowOutputLatency, defaultHighInputLatency, defaultHighOutputLatency;
        double defaultSampleRate;
    } PaDeviceInfo;
    typedef struct {
        int structVersion, type; const char *name; int deviceCount, defaultInputDevice, defaultOutputDevice;
    } PaHostApiInfo;
    typedef struct { int hostApiType; long errorCode; const char *errorText; } PaHostErrorInfo;
    typedef struct {
        int device, channelCount; unsigned long sampleFormat; double suggestedLatency; void *hostApiSpecificStreamInfo;
    } PaStreamParameters;
    int Pa_GetVersion(void);
    const char *Pa_GetErrorText(int error);
    const PaHostErrorInfo *Pa_GetLastHostErrorInfo(void);
    int Pa_Initialize(void);
    int Pa_Terminate(void);
    int Pa_GetDeviceCount(void);
    int Pa_GetDefaultOutputDevice(void);
    const PaDeviceInfo *Pa_GetDeviceInfo(int device);
    const PaHostApiInfo *Pa_GetHostApiInfo(int hostApi);
    int Pa_OpenStream(void **stream, const PaStreamParameters *input, const PaStreamParameters *output, double rate,
                      unsigned long frames, unsigned long flags, void *callback, void *userData);
    int Pa_StartStream(void *stream);
    int Pa_StopStream(void *stream);
    int Pa_CloseStream(void *stream);
    int Pa_IsStreamActive(void *stream);
    double Pa_GetStreamCpuLoad(void *stream);
""")
LEFT_BEHIND: list["Stream"] = []  # streams that PortAudio did not close


@dataclass(frozen=True)
class Card:
    """A sound card as PortAudio lists it: channels, rate (Hz) and latencies (s; low, high), input and output."""

    index: int
    name: str
    host: str  # ALSA, JACK, Core Audio, ASIO ...
    inputs: int
    outputs: int
    rate: float
    input_latency: tuple[float, float]
    output_latency: tuple[float, float]

    @property
    def about(self) -> str:
        """Channels, rate, host and stated latency as text."""
        milliseconds = " + ".join(f"{1e3 * each[0]:.1f}" for each in (self.input_latency, self.output_latency))
        return f"{self.outputs} out, {self.inputs} in, {self.rate:g} Hz, {self.host}, latency {milliseconds} ms"

    def __str__(self) -> str:
        return f"{self.index} {self.name} ({self.about})"


@lru_cache
def load() -> Any:
    """Load PortAudio; a `DeviceNotFound` where there is none, or one older than 19.6."""
    name = find_library("portaudio") or _bundled()
    if name is None:
        raise DeviceNotFound(f"audio: PortAudio is not installed; {INSTALL}")
    try:
        loaded = FFI.dlopen(name)
        version = loaded.Pa_GetVersion()
    except (OSError, AttributeError) as error:
        raise DeviceNotFound(f"audio: {name} is no PortAudio that can be used: {error}; {INSTALL}") from error
    if version < LEAST_VERSION:
        raise DeviceNotFound(f"audio: {name}: version {version:#x} must be >= {LEAST_VERSION:#x} (19.6.0); {INSTALL}")
    return loaded


def _bundled() -> str | None:
    """Path of the library among the files of the installed package sounddevice."""
    bits = 64 if sys.maxsize > 2**32 else 32
    name = {"darwin": "libportaudio.dylib", "win32": f"libportaudio{bits}bit.dll"}.get(sys.platform)
    try:
        found = [file.locate() for file in files("sounddevice") or () if file.name == name]
    except PackageNotFoundError:
        return None
    return str(found[0]) if found else None


def check(code: int, what: str) -> int:
    """Return a result of PortAudio; a `DriverError` that begins with `what` where it is an error."""
    if code >= 0:
        return code
    text = _text(load().Pa_GetErrorText(code))
    if code == HOST_ERROR:
        host = load().Pa_GetLastHostErrorInfo()
        text = f"{text}: {_text(host.errorText)} ({host.errorCode})"
    reason = ANTICIPATED_ERRORS.get(code)
    raise DriverError(f"{what}: {text} (PortAudio {code}{f': {reason}' if reason else ''})")


def _text(found: Any) -> str:
    return FFI.string(found).decode(errors="replace") if found else ""


@contextmanager
def initialised() -> Iterator[Any]:
    """Initialise PortAudio, which lists the cards anew unless it is in use, and terminate it afterwards."""
    portaudio = _initialise("audio")
    try:
        yield portaudio
    finally:
        portaudio.Pa_Terminate()


def _initialise(name: str) -> Any:
    """Initialise PortAudio; a `DriverError` where it is busy with a stream that did not close: it serves one thread."""
    if LEFT_BEHIND:
        raise DriverError(f"{name}: initialise: PortAudio has not closed {LEFT_BEHIND[0].name}: {ADVICE}")
    portaudio = load()
    with _quiet():
        check(portaudio.Pa_Initialize(), f"{name}: initialise")
    return portaudio


@contextmanager
def _quiet() -> Iterator[None]:
    """Discard what ALSA and JACK write to standard error while they look for cards that are absent."""
    if not sys.platform.startswith("linux"):
        yield
        return
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def cards() -> list[Card]:
    """Sound cards that are there now; a `DeviceNotFound` where PortAudio is not."""
    with initialised() as portaudio:
        infos = map(portaudio.Pa_GetDeviceInfo, range(check(portaudio.Pa_GetDeviceCount(), "audio: list")))
        return [
            Card(
                index=index,
                name=_text(info.name),
                host=_text(portaudio.Pa_GetHostApiInfo(info.hostApi).name),
                inputs=info.maxInputChannels,
                outputs=info.maxOutputChannels,
                rate=info.defaultSampleRate,
                input_latency=(info.defaultLowInputLatency, info.defaultHighInputLatency),
                output_latency=(info.defaultLowOutputLatency, info.defaultHighOutputLatency),
            )
            for index, info in enumerate(infos)
        ]


def find(device: int | str | None) -> Card:
    """Card by index (2, "2"), by parts of its name and host ("usb", "Scarlett JACK"), or the default output (None, "").

    A `DeviceNotFound` where no card fits, or more than one, lists those that are there.
    """
    with initialised() as portaudio:
        default = portaudio.Pa_GetDefaultOutputDevice()
    text = "" if device is None else str(device).strip()
    return chosen(cards(), default if not text else int(text) if text.isdigit() else text)


def chosen(found: list[Card], device: int | str) -> Card:
    """Card of `found` that has the index or the parts of `device`, in any case; see `find`."""
    if isinstance(device, str):
        parts = device.lower().split()
        fitting = [each for each in found if all(part in f"{each.name} {each.host}".lower() for part in parts)]
        exact = [each for each in fitting if each.name.lower() == device.lower()]
        fitting = exact or fitting
    else:
        fitting = [each for each in found if each.index == device]
    if len(fitting) == 1:
        return fitting[0]
    listed = "; ".join(map(str, fitting or found)) or "there is no sound card"
    problem = "no default output" if device == -1 else f"{len(fitting)} cards fit"
    raise DeviceNotFound(f"audio: device {device!r}: {problem}: {listed}")


class Stream:
    """A stream of interleaved float samples whose callback is a C function.

    `name` is for error messages; `output` and `inputs` (None: no input) are card, channels and suggested latency (s);
    `frames` are samples a call.  `memory` is what the addresses `callback` and `user_data` point to, and all that the
    callback uses: it is kept as long as PortAudio may call back.
    """

    def __init__(
        self,
        name: str,
        output: tuple[int, int, float],
        inputs: tuple[int, int, float] | None,
        rate: float,
        frames: int,
        callback: int,
        user_data: int,
        memory: Any,
    ) -> None:
        self.name, self._library, self._memory = name, _initialise(name), memory
        null, opened = FFI.NULL, FFI.new("void **")
        sides = [
            FFI.new("PaStreamParameters *", (side[0], side[1], FLOAT32, side[2], null)) if side else null
            for side in (inputs, output)
        ]
        addresses = (FFI.cast("void *", address) for address in (callback, user_data))
        arguments = (*sides, rate, frames, 0, *addresses)
        try:
            check(self._library.Pa_OpenStream(opened, *arguments), f"{name}: open at {rate:g} Hz")
        except DriverError:
            self._library.Pa_Terminate()
            raise
        self._handle: Any = opened[0]

    def start(self) -> None:
        """Start to call back."""
        check(self._library.Pa_StartStream(self._handle), f"{self.name}: start")

    @property
    def active(self) -> bool:
        """Whether it still calls back."""
        return self._handle is not None and self._library.Pa_IsStreamActive(self._handle) == 1

    @property
    def load(self) -> float:
        """Time in the callback over the time of a block, as PortAudio averages it."""
        return 0.0 if self._handle is None else float(self._library.Pa_GetStreamCpuLoad(self._handle))

    def close(self) -> None:
        """Stop after what has been played, and release the card; a second call does nothing.

        A `DriverError` where PortAudio reports an error, or does not return (with JACK, where the server has died): the
        stream is left behind with its memory, and PortAudio is of no more use in this process.
        """
        handle, self._handle = self._handle, None
        if handle is None:
            return
        errors: list[DriverError] = []
        release = threading.Thread(target=self._release, args=(handle, errors), daemon=True)
        release.start()
        release.join(CLOSE_TIMEOUT)
        if release.is_alive():
            LEFT_BEHIND.append(self)
            pythonapi.Py_IncRef(py_object(self))  # it may still be called back while Python ends
            raise DriverError(f"{self.name}: close: PortAudio did not return within {CLOSE_TIMEOUT:g} s: {ADVICE}")
        if errors:
            raise errors[0]

    def _release(self, handle: Any, errors: list[DriverError]) -> None:
        try:
            if self._library.Pa_IsStreamActive(handle) == 1:
                check(self._library.Pa_StopStream(handle), f"{self.name}: stop")
        except DriverError as error:
            errors.append(error)
        for release in (partial(self._library.Pa_CloseStream, handle), self._library.Pa_Terminate):
            if self in LEFT_BEHIND:  # JACK's server may end at any moment: PortAudio 19.6 would abort the process
                return
            release()
