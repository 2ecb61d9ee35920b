"""What the reference says of members: `@remembered` makes properties, systems have parameters."""

import ast
import re
from collections.abc import Iterator

import griffe


# Functions that are named as the makers of a result. Doubled: longer lists.
_MAKERS = 4
# A list of arguments, and the names and the text of an item.
_ARGUMENTS = re.compile(
    r"(?<=\*\*Arguments:\*\*\n\n)(?:- .*\n?(?:(?: +\S.*| *)(?:\n|$))*)+"
)
_ITEM = re.compile(r"((?:`[^`]+`(?:, (?:and )?)?)+)[:,]?\s*(.*)", re.DOTALL)


class Members(griffe.Extension):
    def on_package(self, *, pkg: griffe.Module, **_) -> None:
        """Results say which function gives them: its example shows them."""
        makers: dict[str, list[str]] = {}
        for name, thing in _public(pkg):
            if thing.is_function and thing.returns is not None:
                for word in re.findall(r"\w+", str(thing.returns)):
                    makers.setdefault(word, []).append(name)
        for name, thing in _public(pkg):
            own = makers.pop(name.split(".")[-1], []) if thing.is_class else []
            if thing.docstring and own:
                given = ", ".join(f"`hj.{x}`" for x in own[:_MAKERS])
                thing.docstring.value += f"\n\n*Given by* {given}."

    def on_object(self, *, obj: griffe.Object, **_) -> None:
        if obj.docstring:
            obj.docstring.value = _ARGUMENTS.sub(_table, obj.docstring.value)

    def on_function(self, *, func: griffe.Function, **_) -> None:
        if any(
            decorator.callable_path.endswith("remembered")
            for decorator in func.decorators
        ):
            value = griffe.Attribute(
                func.name,
                annotation=func.returns,
                docstring=func.docstring,
                lineno=func.lineno,
                endlineno=func.endlineno,
                parent=func.parent,
            )
            value.labels |= {"property"}
            func.parent.set_member(func.name, value)

    def on_class_members(self, *, cls: griffe.Class, **_) -> None:
        lines = [
            _parameter(x)
            for x in cls.attributes.values()
            if str(x.annotation) == "Parameter"
        ]
        if lines and cls.docstring:
            cls.docstring.value += "\n\n**Parameters:**\n\n" + "\n".join(lines)


def _table(arguments: re.Match) -> str:
    """A list of arguments as a table."""
    items = re.split(r"^- ", arguments[0], flags=re.MULTILINE)[1:]
    rows = [_ITEM.fullmatch(" ".join(item.split())) for item in items]
    if not all(rows) or any("|" in re.sub("`[^`]*`", "", item) for item in items):
        return arguments[0]
    lines = [f"| {row[1]} | {row[2][:1].upper()}{row[2][1:]} |" for row in rows]
    return "\n".join(["| argument | meaning |", "|---|---|", *lines]) + "\n\n"


def _public(pkg: griffe.Module) -> Iterator[tuple[str, griffe.Object]]:
    """Functions and classes, by the names that the tables of public names give them."""
    for module in (pkg, *(x for x in pkg.modules.values() if x.is_subpackage)):
        path = module.path.removeprefix("hybridjax").removeprefix(".")
        for name, member in module.members.items():
            if member.is_alias and not name.startswith("_"):
                try:
                    yield f"{path}.{name}".removeprefix("."), member.final_target
                except griffe.AliasResolutionError:
                    continue


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
