"""Write the part of the demo page about one texture on several devices, side by side in skin velocity."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from hapticrender.formatting import short
from hapticrender.recordings.recording import Recording
from hapticrender.report.devices_picture import plot_devices
from hapticrender.report.outputs import JOURNAL, Outputs
from hapticrender.skin import felt_bands

PICTURE = "devices.png"


def alike(scenes: Sequence[Outputs]) -> dict[str, Recording]:
    """Recordings of the texture that most devices share, by the device's name; empty where no two share one."""
    groups: dict[str, dict[str, Recording]] = {}
    for scene in scenes:
        if not (scene.folder / JOURNAL).exists():
            continue
        recording = Recording.load(scene.folder / JOURNAL)
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
<p>Each kind of device acts on the finger in its own way: a plate moves the skin, friction pulls at it. The velocity of
the skin is predicted from each recording; it should be the same on all devices.</p>
{picture}
{_table(recordings)}
</section>"""


def _table(recordings: dict[str, Recording]) -> str:
    """Skin velocity of every band on every device, in mm/s."""
    bands = {device: felt_bands(recording) for device, recording in recordings.items()}
    heads = "".join(f"<th>{escape(device)}</th><th>error</th>" for device in bands)
    rows = []
    for each in zip(*bands.values(), strict=True):
        cells = "".join(f"<td>{1e3 * band.achieved:.3f}</td><td>{100 * band.error:+.2f} %</td>" for band in each)
        name, target = short(each[0].frequency, "Hz"), f"{1e3 * each[0].wanted:.3f}"
        rows.append(f'<tr><td class="text">{name}</td><td>{target}</td><td>{each[0].level:.0f} dB</td>{cells}</tr>')
    return f"""<div class="scroll"><table>
<caption>Skin velocity, mm/s peak</caption>
<thead><tr><th class="text">Band</th><th>Target</th><th>Above threshold</th>{heads}</tr></thead>
<tbody>
{chr(10).join(rows)}
</tbody>
</table></div>"""
