from .families import AbstractSections as AbstractSections
