"""hapticrender: renders textures for a bare finger on a surface, in closed loop.

>>> import hapticrender as hr
>>> scene = hr.Scene(texture=hr.Grating(frequency=72.0, amplitude=10e-6), duration=2.0)
>>> recording = hr.render(scene)
>>> f"{1e6 * recording.summary()['bands'][0]['target']:.1f} um"
'10.0 um'

The public names, those of ``__init__.pyi``, are loaded when they are first used, so that importing the package costs
next to nothing.
"""

import re as _re
from importlib import import_module as _import_module
from pathlib import Path as _Path
from typing import Any as _Any

# A wheel holds renderers/ and drivers/ inside this package; in a source checkout they lie beside it, so look there too.
_here = _Path(__file__).parent
if not (_here / "renderers").is_dir():
    __path__.append(str(_here.parent))

__version__ = "0.2.0"

_stub = (_here / "__init__.pyi").read_text(encoding="utf-8")
_HOME_OF = {name: home for home, name in _re.findall(r"^from (hapticrender\.\S+) import (\w+) as", _stub, _re.M)}

__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> _Any:
    if name == "sweep":  # the module, whether or not anything has imported it
        return _import_module(f"{__name__}.sweep")
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(_import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
