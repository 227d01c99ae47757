"""Renders the results tables of the docs from committed files of results.

    tables                # writes every table again
    tables check=true     # says which pages differ, and writes nothing

A table stands in a page between two comments, each at the beginning of a line:

    <!-- table: NAME view=VIEW condition=robot policy=run,blind -->
    <!-- end -->

NAME is a file in `data`, written by evaluate out=, or several with commas. Views: all (every figure), policies (a row
for each world, a column for each policy), worlds (the same with a column for each condition), conditions (a row for
each policy), trained (a row for each run, a column for each policy), trainings (a row for each world, a column for each
training, its seeds together), study (a row for each training and policy), walking (figures of a gait: a row for each
ground), levels (the same, all kinds of ground together), runs (the same, a row for each run). The keys policy, world,
terrain, condition, split and run choose what is shown. Percentages and intervals are those of the outcomes of trials.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omniperception.config import ConfigError
from omniperception.evaluation.report.pages import rendered
from omnirobot.common.cli import Command, argument
from omnirobot.common.files import write_whole
from omnirobot.common.shell import command_line


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    pages: tuple[Path, ...] = argument((Path("README.md"), Path("docs")), "pages, or folders of them")
    data: Path = argument(Path("docs/lab/data"), "folder of the files of results")
    check: bool = argument(False, "whether to compare instead of writing")


def main(arguments: Arguments) -> None:
    """Writes the pages, or refuses those that differ."""
    different = []
    for page in _pages(arguments.pages):
        text = page.read_text("utf-8")
        try:
            new = rendered(text, arguments.data)
        except ConfigError as error:
            raise ConfigError(f"{page}: {error}") from None
        if new != text:
            different.append(str(page))
            if not arguments.check:
                write_whole(page, new)
    shown = ", ".join(different)
    if arguments.check and different:
        again = command_line("tables", f"pages={','.join(map(str, arguments.pages))}", f"data={arguments.data}")
        raise ConfigError(f"{shown} differ from the files of results; commit what this writes: {again}")
    print(f"wrote {shown}" if different else "all tables are those of the files of results")


def _pages(given: tuple[Path, ...]) -> list[Path]:
    for path in given:
        if not path.exists():
            raise ConfigError(f"pages={path} does not exist; run it in a checkout, or give pages=")
    return [page for path in given for page in (sorted(path.rglob("*.md")) if path.is_dir() else [path])]


command = Command(main, Arguments, __doc__)
