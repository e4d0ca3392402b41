"""README's picture, of a solved problem: `python docs/hero.py results/punch`.

The 3D view of `impactopt show` at four instants, beside each other. It takes the browser of the tests (extra
`browser`), and writes docs/figures/hero.png.
"""

from __future__ import annotations

import base64
import io
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image, ImageDraw, ImageFont

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from support.browser import Job, visit  # noqa: E402

from impactopt.files.replay import load_planned  # noqa: E402
from impactopt.report.animation import animation_of  # noqa: E402

PANEL = (560, 780)  # [px], which are drawn twice as large, for smooth edges
LETTERS = 22  # [px]
SKY = ((246, 248, 251), (221, 227, 234))  # from above to below, as on the page
BEGIN = f"""(() => {{
  const p = page.clock, v = p.view;
  p.play(false);
  document.documentElement.dataset.theme = "light";
  v.shown.com = false;
  [v.canvas.width, v.canvas.height] = [{2 * PANEL[0]}, {2 * PANEL[1]}];
  v.look("3/4");
  v.yaw += 0.3;
  v.distance = 3.5 * v.size;
  v.centre[0] += 0.1;
  return true;
}})()"""
# drawn and read at once: a canvas keeps nothing until later
DRAW = "(page.clock.view.draw(0, %.5f), page.clock.view.canvas.toDataURL('image/png'))"


def main(result: Path, out: Path) -> None:
    """Draw the saved result."""
    planned = load_planned(result)
    a = planned.record.arrays
    start, end = float(a["reference_contact_start"]), float(a["reference_contact_end"])
    before, after = 0.4 * start, 0.03
    instants = {
        "at rest": 0.0,
        f"{1e3 * before:.0f} ms before contact": start - before,
        "contact": start + 1e-3,
        f"{1e3 * after:.0f} ms after it": end + after,
    }
    with TemporaryDirectory() as place:
        page = animation_of(planned.record, planned.problem).save(Path(place) / "page.html")
        (seen,) = visit(Job(page=page, scripts=(BEGIN, *(DRAW % time for time in instants.values()))))
    whole = Image.new("RGB", (PANEL[0] * len(instants), PANEL[1]))
    for k, (text, drawn) in enumerate(zip(instants, seen.values[1:], strict=True)):
        whole.paste(_panel(drawn, text), (k * PANEL[0], 0))
    whole.quantize(256, dither=Image.Dither.NONE).save(out, optimize=True)


def _panel(drawn: str, text: str) -> Image.Image:
    """What a canvas has, over the sky, with its name."""
    robot = Image.open(io.BytesIO(base64.b64decode(drawn.partition(",")[2]))).convert("RGBA")
    above, below = (np.array(colour, dtype=float) for colour in SKY)
    down = np.linspace(0, 1, robot.height)[:, None, None]
    sky = np.broadcast_to((1 - down) * above + down * below, (robot.height, robot.width, 3))
    panel = Image.fromarray(np.round(sky).astype(np.uint8)).convert("RGBA")
    panel = Image.alpha_composite(panel, robot).convert("RGB").resize(PANEL, Image.Resampling.LANCZOS)
    font = ImageFont.load_default(LETTERS)
    ImageDraw.Draw(panel).text((PANEL[0] / 2, PANEL[1] - 16), text, fill="#1b1f24", font=font, anchor="mb")
    return panel


if __name__ == "__main__":
    main(Path(sys.argv[1]), ROOT / "docs" / "figures" / "hero.png")
