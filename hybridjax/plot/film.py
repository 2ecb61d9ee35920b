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


def frames(
    figure: Figure, draw: Callable[[int], Sequence[Artist]], count: int, dpi: float
) -> list[Image.Image]:
    """What stands still, and the frames, as images with one palette. Only what moves is drawn anew
    in each frame."""
    canvas, before = figure.canvas, figure.dpi
    try:
        figure.set_dpi(dpi)
        agg = FigureCanvasAgg(figure)
        for artist in draw(0):
            artist.set_animated(True)
        agg.draw()
        background, images = agg.copy_from_bbox(figure.bbox), [_image(agg)]
        for k in range(count):
            agg.restore_region(background)
            for artist in sorted(draw(k), key=lambda x: x.get_zorder()):
                figure.draw_artist(artist)
            images.append(_image(agg))
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


def _image(canvas: FigureCanvasAgg) -> Image.Image:
    return Image.fromarray(np.array(canvas.buffer_rgba())[..., :3])


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
        still=_PNG + _encoded(still), first=_PNG + frames[0], last=len(images) - 1,
        frames=frames, milliseconds=round(1000 * interval),
    )  # fmt: skip


_PNG = "data:image/png;base64,"


def _encoded(image: Image.Image, clear: np.ndarray | bool = False) -> str:
    picture = Image.fromarray(np.where(clear, 255, np.asarray(image)).astype(np.uint8), "P")
    picture.putpalette(image.getpalette() or [])
    file = io.BytesIO()
    picture.save(file, "png", optimize=True, **({} if clear is False else {"transparency": 255}))
    return base64.b64encode(file.getvalue()).decode()
