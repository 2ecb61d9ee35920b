"""What the reference says of members: `@remembered` makes properties, systems have parameters."""

import ast

import griffe


class Members(griffe.Extension):
    def on_function(self, *, func: griffe.Function, **_) -> None:
        if any(decorator.callable_path.endswith("remembered") for decorator in func.decorators):
            value = griffe.Attribute(
                func.name, annotation=func.returns, docstring=func.docstring,
                lineno=func.lineno, endlineno=func.endlineno, parent=func.parent,
            )  # fmt: skip
            value.labels |= {"property"}
            func.parent.set_member(func.name, value)

    def on_class_members(self, *, cls: griffe.Class, **_) -> None:
        lines = [_parameter(x) for x in cls.attributes.values() if str(x.annotation) == "Parameter"]
        if lines and cls.docstring:
            cls.docstring.value += "\n\n**Parameters:**\n\n" + "\n".join(lines)


def _parameter(attribute: griffe.Attribute) -> str:
    """`k: Parameter = parameter(10.0, unit="N/m", doc="stiffness")` as an item of a list."""
    words = {"unit": "", "doc": ""}
    default = ""
    for argument in attribute.value.arguments:
        if isinstance(argument, griffe.ExprKeyword):
            words[argument.name] = ast.literal_eval(str(argument.value))
        else:
            default = f" = {argument}"
    meaning = f": {words['doc']}" if words["doc"] else ""
    return f"- `{attribute.name}`{default} {words['unit']}".rstrip() + meaning
