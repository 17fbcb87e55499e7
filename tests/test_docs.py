"""README and the pages in docs/: every function that they name exists, and every link leads somewhere."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
NAMED = re.compile(r"`([\w/]+\.py)`(?::((?: `[\w.]+`,?)+))?")


def test_functions_in_the_theory_exist():
    named = NAMED.findall((ROOT / "docs" / "theory.md").read_text(encoding="utf-8"))
    assert len(named) > 30
    missing = []
    for file, names in named:
        path = next((each for each in (ROOT / "hapticrender" / file, ROOT / file) if each.exists()), None)
        source = path.read_text(encoding="utf-8") if path else ""
        found = [re.search(rf"(?:def|class) {name.split('.')[-1]}\b", source) for name in re.findall(r"[\w.]+", names)]
        if path is None or not all(found):
            missing.append(f"{file}: {names}")
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = page.read_text(encoding="utf-8")
    for target, anchor in re.findall(r"\]\(([^)#]*)(?:#([^)]*))?\)", text):
        if "://" in target:
            continue
        path = page.parent / target if target else page
        assert path.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w -]", "", each).lower().replace(" ", "-") for each in headings}, anchor


def test_python_on_the_page_about_the_finger_runs(tmp_path, monkeypatch):
    """All in one namespace; the columns that it writes as CSV give the touch that the recording gives."""
    pytest.importorskip("h5py")
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "finger"}
    text = (ROOT / "docs" / "finger.md").read_text(encoding="utf-8")
    for number, block in enumerate(re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)):
        exec(compile(block, f"finger.md, Python block {number}", "exec"), names)
    analyse = names["hr"].analyse_finger
    assert analyse(names["theirs"]).of_kind(2) == names["found"].of_kind(2)
    assert len(names["touch"].time) == 50


def test_python_on_the_page_about_devices_runs():
    """The last position is estimated no farther off than the finger has moved."""
    names = {"__name__": "devices"}
    [block] = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / "devices.md").read_text("utf-8"), re.M | re.S)
    exec(compile(block, "devices.md, Python block", "exec"), names)
    assert abs(names["found"].position - 0.0108) < 0.0108 - 0.0100
