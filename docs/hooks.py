"""For the site: links that leave docs/ lead to the repository, or nowhere while the site has no `repo_url`."""

from __future__ import annotations

import posixpath
import re
from typing import Any

_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(((?:\.\./)+[^)]*)\)")


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Replaces a page's links to files beside docs/."""
    return outward(markdown, page.file.src_uri, config["repo_url"])


def outward(markdown: str, place: str, repo_url: str | None) -> str:
    """Markdown with its links out of docs/ replaced.

    Args:
        markdown: text of a page.
        place: of the page in docs/, such as `guide/lidar.md`.
        repo_url: the repository's address; without it the text of the link stays.
    """

    def replace(link: re.Match) -> str:
        path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(place), link[2]))
        if path.startswith("docs/"):
            return link[0]
        return f"[{link[1]}]({repo_url.rstrip('/')}/blob/main/{path})" if repo_url else link[1]

    return _LINK.sub(replace, markdown)
