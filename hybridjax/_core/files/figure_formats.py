"""The formats of figures, known before anything heavy is imported."""

from typing import Literal


Format = Literal["png", "pdf", "svg"]
