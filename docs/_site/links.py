"""Let the site follow links that leave docs/: every file they lead to becomes a page of it.

On GitHub, the documents link to files of the repository: examples, C sources, other documents. The
site has these below ``source/``.
"""

import posixpath
import re
from pathlib import Path
from typing import Any, Final

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT: Final = Path(__file__).resolve().parents[2]
LINK: Final = re.compile(r"(\]\()([^)\s#:]+)((?:#[^)\s]*)?\))")
LANGUAGES: Final = {".py": "python", ".c": "c", ".h": "c", ".toml": "toml", ".md": "text"}
PICTURES: Final = {".png", ".svg", ".gif"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each file outside of docs/ that a document leads to."""
    waiting = [f"docs/{file.src_uri}" for file in files.documentation_pages()]
    seen = set(waiting)
    while waiting:
        path = waiting.pop()
        if not path.endswith(".md"):
            continue
        for match in LINK.finditer((ROOT / path).read_text(encoding="utf-8")):
            target = _target(path, match[2])
            if target not in seen and not target.startswith("docs/"):
                seen.add(target)
                waiting.append(target)
                files.append(_file(target, config))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Point links to the pages that the site has of their targets."""
    here = page.file.src_uri
    path = here.removeprefix("source/") if here.startswith("source/") else f"docs/{here}"
    if not (ROOT / path).is_file() or page.meta.get("is_listing"):
        return markdown

    def moved(match: re.Match[str]) -> str:
        uri = _uri(_target(path, match[2]))
        return match[1] + posixpath.relpath(uri, posixpath.dirname(here) or ".") + match[3]

    return LINK.sub(moved, markdown)


def _target(path: str, link: str) -> str:
    """The path in the repository that a link of a document leads to."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(path), link))


def _uri(path: str) -> str:
    """The place in the site of a file of the repository."""
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    is_as_it_is = Path(path).suffix in PICTURES | {".md"}
    return f"source/{path}" if is_as_it_is else f"source/{path}.md"


def _file(path: str, config: MkDocsConfig) -> File:
    place = ROOT / path
    if not place.exists():
        raise FileNotFoundError(f"a document links to {path}, which does not exist")
    if place.suffix in PICTURES:
        return File.generated(config, _uri(path), content=place.read_bytes())
    if place.suffix == ".md":
        text = place.read_text(encoding="utf-8")
    elif place.is_dir():
        text = _listing(path, place)
    else:
        text = _listed(path, place)
    return File.generated(config, _uri(path), content=text)


def _listing(path: str, folder: Path) -> str:
    names = sorted(one.name for one in folder.iterdir() if one.name[0] not in "._")
    return f"# {path}/\n\n" + "\n".join(f"- `{name}`" for name in names)


def _listed(path: str, place: Path) -> str:
    language = LANGUAGES.get(place.suffix, "text")
    code = place.read_text(encoding="utf-8")
    return f"# {path}\n\n````{language}\n{code}\n````\n"
