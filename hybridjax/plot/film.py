"""Frames of an animation as images of few colors, and files of them.

`motion.py` calls `frames` for the images, `gif` for a file, and `player` for the HTML of a notebook
or a page; `explorer.py` uses `Easel` and `png`. Only the artists that `draw` returns are drawn anew
in each frame: others stay as they are in the first. All images must have one palette, of fewer than
256 colors: `player` compares the frames by these numbers, and adds one clear color.

If an artist does not move, it is missing among those of `draw`; if a color is wrong, look at
`_PALETTE`; if a GIF is too fast or too slow, at `gif`; if a page has holes, at `clear` in `player`.
"""

import base64
import io
import uuid
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from .look import COLORS


BODY = "#e3ebf3"
"""The color of bodies."""
PNG = "data:image/png;base64,"
_PLAYER = """<div id="{id}" style="display:inline-block;max-width:100%">
<div style="position:relative;width:{width}px;max-width:100%">
<img alt="{alt}" src="{still}" style="width:100%">
<img alt="" src="{first}" style="width:100%;position:absolute;left:0;top:0"></div>
<button title="pause or play">&#9654;&#8214;</button>
<input type="range" min="0" max="{last}" value="0" style="width:75%;vertical-align:middle">
<script>(() => {{
const box = document.getElementById("{id}"), frames = {frames};
const [image, button, slider] = ["img+img", "button", "input"].map(x => box.querySelector(x));
let playing = true;
const show = k => {{ image.src = frames[k]; slider.value = k; }};
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
            # (Marimo gives the figure another canvas.)
            artist.draw(self._agg.get_renderer())
        return Image.fromarray(np.array(self._agg.buffer_rgba())[..., :3])


def frames(
    figure: Figure,
    draw: Callable[[int], Sequence[Artist]],
    count: int,
    dpi: float,
) -> list[Image.Image]:
    """Images with one palette."""
    canvas = figure.canvas
    before = figure.dpi
    try:
        easel = Easel(figure, draw(0), dpi)
        images = [easel.image(draw(k)) for k in range(count)]
    finally:
        figure.set_dpi(before)
        figure.set_canvas(canvas)
    palette = Image.new("P", (1, 1))
    palette.putpalette(_PALETTE.round().astype(int).ravel().tolist())
    return [
        image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images
    ]


# White, that of bodies, and each of the palette in four shades, as at the borders of lines. More
# shades: larger files. Fewer: lines have rough borders.
_INKS = np.array([to_rgb(color) for color in COLORS.values()])
_SHADES = (1 + np.arange(1, 5)[:, None, None] / 4 * (_INKS - 1)).reshape(-1, 3)
_WHITE = np.ones(3)
_PALETTE = 255 * np.vstack([_WHITE, to_rgb(BODY), _SHADES])


def gif(images: Sequence[Image.Image], interval: float) -> bytes:
    """A GIF that repeats. Its times are whole hundredths of a second, which together last as long
    as the frames."""
    numbers = np.arange(len(images) + 1)
    ends = np.round(100 * interval * numbers)
    file = io.BytesIO()
    durations = [10 * max(2, int(x)) for x in np.diff(ends)]
    options: Any = {"save_all": True, "loop": 0, "disposal": 1}
    images[0].save(file, "gif", append_images=images[1:], duration=durations, **options)
    return file.getvalue()


def player(images: Sequence[Image.Image], interval: float, alt: str) -> str:
    """HTML that shows the frames one after the other, with a button and a slider, and needs no
    other file. Each frame holds what differs from the pixels that most frames have, upon which it
    lies."""
    pixels = np.stack([np.asarray(image) for image in images])
    usual = np.sort(pixels, axis=0)[len(pixels) // 2]
    # (The clear color is the last of the palette: browsers show one beyond its end as gray.)
    clear = len(_PALETTE)
    colors = images[0].getpalette() or []
    palette = [*colors[: 3 * clear], 0, 0, 0]

    def encoded(pixels: np.ndarray, **options: Any) -> str:
        image = Image.fromarray(pixels.astype(np.uint8), "P")
        image.putpalette(palette)
        return png(image, optimize=True, **options)

    files = [
        encoded(np.where(x == usual, clear, x), transparency=clear) for x in pixels
    ]
    return _PLAYER.format(
        id=f"motion-{uuid.uuid4().hex[:8]}",
        width=images[0].width * 4 // 5,
        alt=alt,
        still=encoded(usual),
        first=files[0],
        last=len(files) - 1,
        frames=files,
        milliseconds=round(1000 * interval),
    )


def png(image: Image.Image, **options: Any) -> str:
    """The address of an image that holds the image itself."""
    file = io.BytesIO()
    image.save(file, "png", **options)
    return PNG + base64.b64encode(file.getvalue()).decode()
