"""The API pages: a page for each folder of the package, made from its public names."""

import importlib
import inspect
import pathlib
import re
from collections.abc import Iterator

ROOMS = {
    "lens": "Lenses, glasses, paraxial optics",
    "files": "Lens files",
    "rays": "Rays",
    "pupil": "Rules of the pupil",
    "image": "Spots, wavefronts, kernels, images",
    "design": "Design and tolerances",
    "learn": "Network and training",
    "show": "Pictures",
    "compilation": "Keeping compiled programs",
    "devices": "Sharing work among devices",
}
# Modules with public names, by what a user imports.
MODULES = ("drt_jax", "drt_jax.pupil", "drt_jax.design", "drt_jax.show", "drt_jax.devices")
MODULES += ("drt_jax.learn", "drt_jax.results")


def public() -> dict[str, dict[str, object]]:
    """Public names of each folder, in full, and what they are."""
    found: dict[str, dict[str, object]] = {room: {} for room in ROOMS}
    for path in MODULES:
        module = importlib.import_module(path)
        here = hasattr(module, "__path__") or path == "drt_jax.results"  # else own names alone
        for name, thing in vars(module).items():
            source = getattr(inspect.unwrap(thing), "__module__", "") if callable(thing) else ""
            own = source.startswith("drt_jax.") and (here or source == path)
            if own and not name.startswith("_"):
                found[source.split(".")[1]][f"{path}.{name}"] = thing
    return found


def directive(name: str, thing: object) -> str:
    """What autodoc is asked for one name."""
    if inspect.isclass(thing):
        fields = ", ".join(getattr(thing, "__annotations__", {}))
        return f".. autoclass:: {name}\n   :members:\n   :exclude-members: {fields}\n"
    return f".. autofunction:: {name}\n"


def write(folder: pathlib.Path) -> None:
    """Write the pages into a folder; one that has not changed keeps its time."""
    folder.mkdir(exist_ok=True)
    for room, names in public().items():
        blocks = "\n".join(directive(name, thing) for name, thing in names.items())
        text = f"# {ROOMS[room]}\n\n```{{eval-rst}}\n{blocks}```\n"
        page = folder / f"{room}.md"
        if not page.exists() or page.read_text() != text:
            page.write_text(text)


def with_fields(app, what, name, thing, options, lines: list[str]) -> None:
    """Turn "name: what it is" in a docstring into lists of parameters. A line may hold several;
    what is indented goes on with the line above."""
    try:
        names = set(inspect.signature(thing).parameters)
    except (TypeError, ValueError):
        names = set()
    names |= set(getattr(thing, "__annotations__", {}))
    if not names:
        return
    one = "|".join(map(re.escape, names))
    start = re.compile(rf"(?:^|(?<=[.;] ))((?:{one})(?:, (?:{one}))*): ")
    found: list[str] = []
    listed = False
    for line in _whole(lines):
        before, *parts = start.split(line)
        if (listed or parts) and found and found[-1] and not (listed and parts and not before):
            found.append("")
        if before or not parts:
            found += [before, ""] if parts else [before]
        for head, text in zip(parts[::2], parts[1::2]):
            found += [f":param {each}: {text.strip()}" for each in head.split(", ")]
        listed = bool(parts)
    lines[:] = found


def _whole(lines: list[str]) -> Iterator[str]:
    """Lines of a docstring, each with those that go on with it: indented, or behind a line that
    names something and ends without a full stop."""
    whole: list[str] = []
    for line in lines:
        last = whole[-1] if whole else ""
        named = ": " in last and not last.startswith(("- ", "|", "    "))
        open_ended = named and last[-1] not in ".:|" and not line.startswith(("- ", "|"))
        if last and line and (line.startswith("    ") or open_ended) and not last.endswith("::"):
            whole[-1] += " " + line.strip()
        else:
            whole.append(line)
    return iter(whole)
