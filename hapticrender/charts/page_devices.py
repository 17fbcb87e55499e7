"""The part of the demo page that shows one texture on several devices, side by side in skin velocity."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from hapticrender import wording
from hapticrender.charts.skin_picture import plot_devices
from hapticrender.outputs import Outputs
from hapticrender.recordings.recording import Recording
from hapticrender.skin import felt_bands

PICTURE = "devices.png"


def alike(scenes: Sequence[Outputs]) -> dict[str, Recording]:
    """Recordings of the texture that most devices share, by the device's name; empty where no two share one."""
    groups: dict[str, dict[str, Recording]] = {}
    for scene in scenes:
        if not (scene.folder / "recording.au").exists():
            continue
        recording = Recording.load(scene.folder / "recording.au")
        key = f"{recording.scene.texture!r}; {recording.scene.finger!r}"
        groups.setdefault(key, {}).setdefault(scene.summary["device"], recording)
    best = max(groups.values(), key=len, default={})
    return best if len(best) > 1 else {}


def devices_section(folder: Path, scenes: Sequence[Outputs]) -> str:
    """HTML of the section, its picture drawn into `folder`; empty where no two devices share a texture."""
    recordings = alike(scenes)
    if not recordings:
        return ""
    try:
        plot_devices(recordings, folder / PICTURE)
        picture = f'<a href="{PICTURE}"><img src="{PICTURE}" alt="Skin velocity of one texture on every device"></a>'
    except ImportError:
        picture = '<p class="note">No picture: matplotlib is not installed.</p>'
    return f"""<section id="devices">
<h2>One texture, {len(recordings)} devices</h2>
<p>Every kind of device makes something else: a plate moves the skin, friction pulls at it. What they share is the
velocity of the skin under the finger; it is predicted from what each device did, and should be the same.</p>
{picture}
{_table(recordings)}
</section>"""


def _table(recordings: dict[str, Recording]) -> str:
    """Skin velocity of every band on every device."""
    bands = {device: felt_bands(recording) for device, recording in recordings.items()}
    heads = "".join(f"<th>{escape(device)}</th>" for device in bands)
    rows = []
    for each in zip(*bands.values(), strict=True):
        cells = "".join(
            f"<td>{wording.quantity(band.achieved, 'm/s')} ({100 * band.error:+.2f} %)</td>" for band in each
        )
        name, wanted = wording.short(each[0].frequency, "Hz"), wording.quantity(each[0].wanted, "m/s")
        rows.append(f'<tr><td class="text">{name}</td><td>{wanted}</td><td>{each[0].level:.0f} dB</td>{cells}</tr>')
    return f"""<div class="scroll"><table>
<thead><tr><th class="text">Band</th><th>Wanted</th><th>Above threshold</th>{heads}</tr></thead>
<tbody>
{chr(10).join(rows)}
</tbody>
</table></div>"""
