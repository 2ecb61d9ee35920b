"""Frames of an animation as images of few colors, and files of them."""

import base64
import io
import uuid
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from .look import COLORS


BODY = "#e3ebf3"
"""The color of bodies."""
_PLAYER = """<div id="{id}" style="display:inline-block;max-width:100%">
<div style="position:relative;width:{width}px;max-width:100%">
<img alt="{alt}" src="{still}" style="width:100%">
<img alt="" src="{first}" style="width:100%;position:absolute;left:0;top:0"></div>
<button title="pause or play">&#9199;</button>
<input type="range" min="0" max="{last}" value="0" style="width:75%;vertical-align:middle">
<script>(() => {{
const box = document.getElementById("{id}"), [image, button, slider] =
  ["img+img", "button", "input"].map(x => box.querySelector(x)), frames = {frames};
let playing = true;
const show = k => {{ image.src = "data:image/png;base64," + frames[k]; slider.value = k; }};
button.onclick = () => {{ playing = !playing; }};
slider.oninput = () => {{ playing = false; show(+slider.value); }};
const timer = setInterval(() => {{
  if (!box.isConnected) clearInterval(timer);
  else if (playing) show((+slider.value + 1) % frames.length);
}}, {milliseconds});
}})();</script></div>"""


class Easel:
    """A figure of which only the artists that move are drawn anew for each image."""

    def __init__(self, figure: Figure, moving: Sequence[Artist], dpi: float):
        figure.set_dpi(dpi)
        self._agg = FigureCanvasAgg(figure)
        for artist in moving:
            artist.set_animated(True)
        self._agg.draw()
        self._still = self._agg.copy_from_bbox(figure.bbox)

    def image(self, moving: Sequence[Artist]) -> Image.Image:
        self._agg.restore_region(self._still)
        for artist in sorted(moving, key=lambda x: x.get_zorder()):
            artist.draw(self._agg.get_renderer())  # (marimo gives the figure another canvas)
        return Image.fromarray(np.array(self._agg.buffer_rgba())[..., :3])


def frames(
    figure: Figure, draw: Callable[[int], Sequence[Artist]], count: int, dpi: float
) -> list[Image.Image]:
    """What stands still, and the frames, as images with one palette."""
    canvas, before = figure.canvas, figure.dpi
    try:
        easel = Easel(figure, draw(0), dpi)
        images = [easel.image([]), *(easel.image(draw(k)) for k in range(count))]
    finally:
        figure.set_dpi(before)
        figure.set_canvas(canvas)
    palette = Image.new("P", (1, 1))
    palette.putpalette(_PALETTE.round().astype(int).ravel().tolist())
    return [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]


# White, that of bodies, and each of the palette in four shades, as at the borders of lines.
_INKS = np.array([to_rgb(color) for color in COLORS.values()])
_SHADES = (1 + np.arange(1, 5)[:, None, None] / 4 * (_INKS - 1)).reshape(-1, 3)
_PALETTE = 255 * np.vstack([np.ones(3), to_rgb(BODY), _SHADES])


def gif(images: Sequence[Image.Image], interval: float) -> bytes:
    """A GIF that repeats. Its times are whole hundredths of a second, which together last as long
    as the frames."""
    first, *following = images
    ends = np.round(100 * interval * np.arange(len(images) + 1))
    durations = [int(10 * max(2, x)) for x in np.diff(ends)]
    file, options = io.BytesIO(), {"duration": durations, "loop": 0, "disposal": 1}
    first.save(file, "gif", save_all=True, append_images=following, **options)
    return file.getvalue()


def player(still: Image.Image, images: Sequence[Image.Image], interval: float, alt: str) -> str:
    """HTML that shows the frames one after the other, with a button and a slider, and needs no
    other file. Each frame holds what differs from the still image, upon which it lies."""
    frames = [_encoded(image, np.asarray(image) == np.asarray(still)) for image in images]
    return _PLAYER.format(
        id=f"motion-{uuid.uuid4().hex[:8]}", width=still.width * 2 // 3, alt=alt,
        still=PNG + _encoded(still), first=PNG + frames[0], last=len(images) - 1,
        frames=frames, milliseconds=round(1000 * interval),
    )  # fmt: skip


PNG = "data:image/png;base64,"


def _encoded(image: Image.Image, clear: np.ndarray | bool = False) -> str:
    # (The clear color is the last of the palette: browsers show one beyond its end as gray.)
    last = len(_PALETTE)
    picture = Image.fromarray(np.where(clear, last, np.asarray(image)).astype(np.uint8), "P")
    picture.putpalette([*(image.getpalette() or [])[: 3 * last], 0, 0, 0])
    file = io.BytesIO()
    picture.save(file, "png", optimize=True, **({} if clear is False else {"transparency": last}))
    return base64.b64encode(file.getvalue()).decode()
