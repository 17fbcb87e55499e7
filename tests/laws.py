"""Exported laws in C behind the face of a controller, and what the simulated plate is to play under them."""

import ctypes
from types import SimpleNamespace

import numpy as np
from board import CAREFUL, ROOT, compile_c
from waves import Own, white

import hapticrender as hr
from hapticrender.export import export
from hapticrender.jit import addresses
from hapticrender.plants.plate import Plate, PlateParameters

RATE, SAMPLES, AHEAD = 5000, 15_000, 7  # Hz; of a run; by which a waveform is ahead: the delay and 6
PARTS = ("law", "learning", "carriers", "supervisor", "gains", "design")
KINDS = {"double": "-DREAL_DOUBLE", "float": "-UREAL_DOUBLE"}


class White(Own):
    """White noise of 20-400 Hz, 5 um rms, played whole."""

    def __init__(self, spatial=False):
        self.values, last = white(SAMPLES + AHEAD, 5e-6), SAMPLES + AHEAD - 1
        super().__init__(lambda time, _: self.values[np.minimum(np.round(time * RATE).astype(int), last)], spatial)


FINGERS = {
    "touch": hr.Finger.still(0.015, normal_load=0.6, mechanics="heavy", touches=[(0.8, 2.2)]),
    "slide": hr.Finger.sliding(speed=0.08, normal_load=0.6, span=0.08, touches=[(0.3, 1.5), (1.7, 9.0)]),
    "sweep": hr.Finger.swiping(frequency=1.0, speed=0.12, normal_load=0.4, mechanics="light"),
}
TEXTURES = {
    "tones": hr.Grating(amplitude=10e-6, frequency=60.0, partials=((1.0, 1.0, 0.0), (2.4, 0.4, 1.0))),
    "grating": hr.Grating(amplitude=10e-6, wavelength=1e-3),
    "white": White(),
    "white-spatial": White(spatial=True),
}


DEVICES = {
    "one coil": {"coils": 1},
    "late": {"delay": 3},
    "fast": {"rate": 10e3},
    "card": {"rate": 48e3, "delay": 40},
    "bending": {"bending_frequency": 1250.0, "bending_coil": 0.1},
}


class Law:
    """A law in C at rest, with the face of a controller, so that the simulated plate can be closed with it."""

    block, n_bands = 1, 0

    def __init__(self, code, name="law"):
        self.code, self.rows = code, getattr(code, f"{name}_rows")
        self.state = np.zeros(getattr(code, f"{name}_size")(), np.uint8)
        self.step = SimpleNamespace(address=ctypes.cast(self.rows, ctypes.c_void_p).value)
        getattr(code, f"{name}_start")(self.address)

    @property
    def address(self):
        return self.state.ctypes.data

    def set_bands(self, *rows):
        rows = np.array(rows, float).reshape(-1, 5)
        return self.code.law_bands(self.address, rows.ctypes.data, len(rows))

    def envelopes(self, band):
        found = np.zeros(4)
        self.code.law_envelope(self.address, band, found.ctypes.data)
        return complex(*found[:2]), complex(*found[2:])

    def covariance(self):
        found = np.zeros((18, 18))
        self.code.law_covariance(self.address, found.ctypes.data)
        return found

    def run(self, sensed, position, waveform, channels=2):
        drive, flags = np.zeros((len(sensed), channels)), np.zeros(len(sensed), np.int64)
        signals = addresses(drive=drive, sensed=sensed, position=position, waveform=waveform, flags=flags)
        self.rows(self.address, signals.ctypes.data, 0, len(sensed))
        return drive, flags


class Exports:
    """Designs of the textures, and their laws in C, each built once."""

    def __init__(self, folder):
        self.folder, self.renderings, self.parts, self.libraries = folder, {}, {}, {}

    def rendering(self, name):
        """Scene whose drive is not rounded: a last bit would decide which way, and both would differ from then on.

        Its name is a texture's, or that of a device, which plays tones.
        """
        if name not in self.renderings:
            texture, profile = TEXTURES.get(name, TEXTURES["tones"]), {"current_bits": 0} | DEVICES.get(name, {})
            fields = {"duration": 3.0, "finger": FINGERS["slide"], "profile": profile, "keep_unfelt": True}
            self.renderings[name] = hr.prepare(hr.Scene(texture=texture, **fields))
        return self.renderings[name]

    def law(self, texture, kind, name="law"):
        key = texture, kind
        if key not in self.libraries:
            self.libraries[key] = self.build(texture, kind)
        return Law(self.libraries[key], name)

    def build(self, texture, kind):
        folder = self.folder / texture.replace(" ", "-")
        if not folder.exists():
            export(self.rendering(texture), folder)
        options = ("-O1", "-fPIC", KINDS[kind], f"-I{folder}", *CAREFUL, "-Wdouble-promotion")
        sizes = kind, (folder / "design.h").read_text()
        if sizes not in self.parts:  # designs of equal sizes share all but their tables
            files = [*(folder / f"{name}.c" for name in PARTS[:-1]), ROOT / "tests" / "law_step.c"]
            self.parts[sizes] = [compile_c(folder / f"{each.stem}-{kind}.o", [each], *options, "-c") for each in files]
        files = [*self.parts[sizes], folder / "design.c"]
        library = ctypes.CDLL(str(compile_c(folder / f"law-{kind}.so", files, *options, "-shared")))
        address, number, count = ctypes.c_int64, ctypes.c_double, ctypes.c_uint32
        library.law_size.restype = library.supervised_size.restype = ctypes.c_size_t
        library.law_differs.restype = number
        for name, types in {
            "law_start": (address,),
            "law_limit": (address, number),
            "law_gain": (address, number),
            "law_bands": (address, address, count),
            "law_envelope": (address, count, address),
            "law_covariance": (address, address),
            "law_differs": (address,),
            "law_rows": (address,) * 4,
            "supervised_start": (address,),
            "supervised_cause": (address,),
            "supervised_rows": (address,) * 4,
        }.items():
            getattr(library, name).argtypes = types
        return library


def ahead_of(texture):
    """Reference that a law is handed: of a waveform `AHEAD` samples early, 0 beside bands."""
    return texture.values[AHEAD:].copy() if isinstance(texture, White) else np.zeros(SAMPLES)


def close(controller, finger, texture, bits=0):
    """Drive, flags and signals of the simulated plate under a controller, and the plate."""
    plate = Plate(PlateParameters(current_bits=bits), finger, seed=1)
    drive, _, flags, signals = plate.closed_loop(controller, ahead_of(texture))
    return drive, flags, signals, plate


def kernel_of(exports, texture, limit=None):
    controller = exports.rendering(texture).controller().controller  # without its supervisor
    if limit is not None:
        controller.state["p"]["drive_limit"] = limit
    return controller
