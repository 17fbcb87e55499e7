"""hapticrender: makes a bare finger feel a texture on a surface, in closed loop."""

from pathlib import Path as _Path

# A wheel holds renderers/ and drivers/ inside this package; in a source checkout they lie beside it, so look there too.
_here = _Path(__file__).parent
if not (_here / "renderers").is_dir():
    __path__.append(str(_here.parent))

__version__ = "0.1.0"
