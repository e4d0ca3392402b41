"""Pictures of solved problems by the 3D view of `impactopt show`; they take the browser of the tests (extra
`browser`).

* `python docs/hero.py results/punch` writes README's, docs/figures/hero.png: four instants beside each other;
* `python docs/hero.py results/robots` writes docs/figures/robots.png, after `make robots`: each at contact.
"""

from __future__ import annotations

import base64
import io
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from benchmarks.robots import ROBOTS, file_of  # noqa: E402
from support.browser import Job, visit  # noqa: E402

from impactopt.files.replay import load_planned  # noqa: E402
from impactopt.report.animation import animation_of  # noqa: E402

PANEL = (560, 780)  # [px], which are drawn twice as large, for smooth edges
SMALL, COLUMNS = (300, 280), 6  # of a gallery: a panel's size without its text, and how many are in a line
LETTERS = 22  # [px]
SKY = ((246, 248, 251), (221, 227, 234))  # from above to below, as on the page
BEGIN = """(() => {
  const p = page.clock, v = p.view;
  p.play(false);
  document.documentElement.dataset.theme = "light";
  v.shown.com = false;
  [v.canvas.width, v.canvas.height] = [%d, %d];
  v.look("3/4");
  v.yaw += 0.3;
  v.distance = %g * v.size;
  v.centre[0] += %g;
  return true;
})()"""
# drawn and read at once: a canvas keeps nothing until later
DRAW = "(page.clock.view.draw(0, %.5f), page.clock.view.canvas.toDataURL('image/png'))"


def instants(result: Path) -> Image.Image:
    """A motion at four instants."""
    a = load_planned(result).record.arrays
    start, end = float(a["reference_contact_start"]), float(a["reference_contact_end"])
    before, after = 0.4 * start, 0.03
    times = {
        "at rest": 0.0,
        f"{1e3 * before:.0f} ms before contact": start - before,
        "contact": start + 1e-3,
        f"{1e3 * after:.0f} ms after it": end + after,
    }
    drawn = _drawn({result: tuple(times.values())}, PANEL, 3.5, 0.1)
    return _side_by_side(
        [_panel(one, text, PANEL) for one, text in zip(drawn, times, strict=True)], len(times)
    )


def gallery(drafts: Path) -> Image.Image:
    """Each robot that has a plan, at contact."""
    names = {file_of(name, drafts).with_suffix(""): name for name in ROBOTS}
    found = {place: load_planned(place).record for place in names if place.is_dir()}
    if not found:
        raise SystemExit(f"{drafts} holds no result of `impactopt solve` or `make robots`")
    times = {place: (float(r.arrays["reference_contact_start"]) + 1e-3,) for place, r in found.items()}
    texts = [f"{names[place]}: {r.summary['impulse_Ns']:.3g} N s" for place, r in found.items()]
    drawn = _drawn(times, SMALL, 3.3, 0.0)
    return _side_by_side([_panel(one, text, SMALL) for one, text in zip(drawn, texts, strict=True)], COLUMNS)


def _drawn(
    times: dict[Path, tuple[float, ...]], size: tuple[int, int], distance: float, ahead: float
) -> list[str]:
    """Canvases of results at their times, as data URLs.  size [px], half of theirs.  distance : of the
    viewer, over the scene's size.  ahead [m] : shift of the view."""
    begin = BEGIN % (2 * size[0], 2 * size[1], distance, ahead)
    with TemporaryDirectory() as place:
        jobs = []
        for k, (result, at) in enumerate(times.items()):
            planned = load_planned(result)
            page = animation_of(planned.record, planned.problem).save(Path(place) / f"{k}.html")
            jobs.append(Job(page=page, scripts=(begin, *(DRAW % time for time in at))))
        return [value for seen in visit(*jobs) for value in seen.values[1:]]


def _side_by_side(panels: list[Image.Image], columns: int) -> Image.Image:
    width, height = panels[0].size
    whole = Image.new("RGB", (width * columns, height * -(-len(panels) // columns)), SKY[0])
    for k, panel in enumerate(panels):
        whole.paste(panel, (k % columns * width, k // columns * height))
    return whole


def _panel(drawn: str, text: str, size: tuple[int, int]) -> Image.Image:
    """What a canvas has, over the sky, with its name."""
    robot = Image.open(io.BytesIO(base64.b64decode(drawn.partition(",")[2]))).convert("RGBA")
    above, below = (np.array(colour, dtype=float) for colour in SKY)
    down = np.linspace(0, 1, robot.height)[:, None, None]
    sky = np.broadcast_to((1 - down) * above + down * below, (robot.height, robot.width, 3))
    panel = Image.fromarray(np.round(sky).astype(np.uint8)).convert("RGBA")
    panel = Image.alpha_composite(panel, robot).convert("RGB").resize(size, Image.Resampling.LANCZOS)
    middle = size[1] - LETTERS
    if size is SMALL:  # a robot reaches down there
        middle = size[1] + LETTERS
        panel = ImageOps.expand(panel, (0, 0, 0, 2 * LETTERS), fill=SKY[0])
    font = ImageFont.load_default(LETTERS * (0.75 if size is SMALL else 1))
    ImageDraw.Draw(panel).text((size[0] / 2, middle), text, fill="#1b1f24", font=font, anchor="mm")
    return panel


if __name__ == "__main__":
    given = Path(sys.argv[1])
    one = (given / "solution.npz").exists()
    picture = instants(given) if one else gallery(given)
    out = ROOT / "docs" / "figures" / ("hero.png" if one else "robots.png")
    picture.quantize(256, dither=Image.Dither.NONE).save(out, optimize=True)
