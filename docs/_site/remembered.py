"""For the reference, a method that is decorated with `@remembered` is a property."""

import griffe


class Remembered(griffe.Extension):
    def on_function(self, *, func: griffe.Function, **_) -> None:
        if any(decorator.callable_path.endswith("remembered") for decorator in func.decorators):
            value = griffe.Attribute(
                func.name, annotation=func.returns, docstring=func.docstring,
                lineno=func.lineno, endlineno=func.endlineno, parent=func.parent,
            )  # fmt: skip
            value.labels |= {"property"}
            func.parent.set_member(func.name, value)
