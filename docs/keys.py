"""The directive `{keys} MODULE:CLASS`: a table of the TOML keys that a dataclass reads."""

import ast
import dataclasses
import importlib
import inspect
import json
import re
import textwrap

from sphinx.util.docutils import SphinxDirective


def attributes(docstring):
    """What the section `Attributes` of a docstring says of each name."""
    section = inspect.cleandoc(docstring).partition("Attributes:\n")[2].partition("\n\n")[0]
    entries = re.split(r"\n(?=\S)", textwrap.dedent(section).strip("\n"))
    pairs = (entry.partition(":")[::2] for entry in entries)
    return {
        name.strip(): " ".join(text.split()) for names, text in pairs for name in names.split(",")
    }


def comments(cls):
    """The comment behind each field."""
    source = textwrap.dedent(inspect.getsource(cls))
    lines = source.splitlines()
    fields = (node for node in ast.parse(source).body[0].body if isinstance(node, ast.AnnAssign))
    texts = ((node.target.id, lines[node.end_lineno - 1].partition("  # ")[2]) for node in fields)
    return {name: text for name, text in texts if text and not text.startswith("type:")}


def default(field):
    """A default as TOML writes it; empty if the key is required or has none."""
    if field.default_factory is not dataclasses.MISSING:
        return ""
    value = getattr(field.default, "value", field.default)
    if value is dataclasses.MISSING or value is None:
        return "" if value is None else "required"
    return f"`{json.dumps(value, default=str)}`"


class Keys(SphinxDirective):
    """The fields of a dataclass: name, type, limits if the module has them, default and meaning."""

    required_arguments = 1

    def run(self):
        """Return the table."""
        module, _, name = self.arguments[0].partition(":")
        code = importlib.import_module(module)
        cls = getattr(code, name)
        meanings = attributes(cls.__doc__) | comments(cls)
        limits = getattr(code, "LIMITS", {})
        rows = [
            f"| `{field.name}` | {kind(field.type)}{between(limits.get(field.name))} "
            f"| {default(field)} | {meanings.get(field.name, '')} |"
            for field in dataclasses.fields(cls)
        ]
        text = "\n".join(["| key | type | default | meaning |", "|---|---|---|---|", *rows])
        return self.parse_text_to_nodes(text)


def between(limits):
    """The smallest and the largest number, in words; empty without limits."""
    return "" if limits is None else f", {limits[0]:.10g} to {limits[1]:.10g}"


def kind(annotation):
    """A type as a reader of TOML knows it."""
    text = annotation if isinstance(annotation, str) else annotation.__name__
    text = text.replace(" | None", "")
    for start, name in (("tuple", "list"), ("dict", "table"), ("Mapping", "table")):
        text = name if text.startswith(start) else text
    return text.replace("Vector3", "3 numbers").replace("|", "or")


def setup(app):
    """Register the directive."""
    app.add_directive("keys", Keys)
    return {"parallel_read_safe": True}
