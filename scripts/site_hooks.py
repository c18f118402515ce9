# SPDX-License-Identifier: Apache-2.0
"""Hooks of mkdocs.yml: what the site has beside the pages of `docs/`.

* A page of reference for each package, made from the listing in its docstring.
* The files of the repository that a page links to (`../assets/cells/demo/cell.yaml`), below `repository/`.
* The order of the pages.
* Checks that fail the build: a public name without a docstring, and anything that a browser would load from elsewhere.
"""

from __future__ import annotations

import ast
import posixpath
import re
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

CHECKOUT = Path(__file__).resolve().parent.parent
DOCS = "docs"
FRONT = "index.md"
NO_LIBRARY = {"benchmarks", "qualification", "tests"}
"""Packages that nobody imports: their commands are in the README and the Makefile."""

REFERENCE, REPOSITORY = "reference", "repository"
FIRST = (
    "index.md",
    "getting-started.md",
    "architecture.md",
    "glossary.md",
    "cell.md",
    "unit.md",
    "calibration.md",
    "watching.md",
    "rest.md",
    "viewer.md",
    "recording.md",
    "library.md",
    "deploy.md",
)
"""Pages in the order in which they are read; all others follow by name."""
ALWAYS = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "examples/README.md", "benchmarks/REPORT.md")
"""Pages of the repository that the site has even where no page links to them."""

STYLE = ".md-grid { max-width: 76rem }\n"
"""Room for a line of code and a wide table."""

LISTED = re.compile(r"^ {4}(\w+)(/?) +(\S.*)$")
FENCE = re.compile(r"^ *(```+|~~~+)")
LINK = re.compile(
    r'(?P<before>\]\(|\b(?:src|href)=")(?P<target>(?![a-z]+:|#|//)[^)"\s#]+)(?P<after>#[^)"\s]*)?(?=[)"\s])'
)
MARKER = re.compile(r"([-*+]|\d+[.)])( +)\S")
IN_LIST = re.compile(r" |[-*+] |\d+[.)] ")
LANGUAGES = {
    ".py": "python",
    ".yaml": "yaml",
    ".yml": "yaml",
    ".toml": "toml",
    ".sh": "sh",
    ".service": "ini",
    "": "sh",
}
PICTURES = {".png", ".gif", ".svg", ".jpg", ".pdf"}


# --- packages -------------------------------------------------------------------------------------------------------


def packages(root: Path) -> list[Path]:
    """Return the folder of every package that can be imported as a library, a package before those in it."""
    tops = sorted(file.parent for file in root.glob("*/__init__.py") if file.parent.name not in NO_LIBRARY)
    return [file.parent for top in tops for file in sorted(top.rglob("__init__.py"))]


def listed(package: Path) -> list[tuple[str, bool, str]]:
    """Return the modules that a package's docstring lists, in its order: name, True for a package, the line on it."""
    text = ast.get_docstring(ast.parse((package / "__init__.py").read_text(encoding="utf-8")), clean=False) or ""
    found = [match.groups() for line in text.splitlines() if (match := LISTED.match(line))]
    return [(name, slash == "/", says) for name, slash, says in found]


def re_exported(package: Path) -> list[tuple[str, str]]:
    """Return each name that a package re-exports, and the dotted name of the module that has it."""
    tree = ast.parse((package / "__init__.py").read_text(encoding="utf-8"))
    public = [
        node.value for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    ]
    names = set(ast.literal_eval(public[0])) if public else set()
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return [(alias.name, str(node.module)) for node in imports for alias in node.names if alias.name in names]


def reference_of(package: Path, root: Path) -> str:
    """Return the Markdown of a package's page of reference."""
    dotted = ".".join(package.relative_to(root).parts)
    text = ast.get_docstring(ast.parse((package / "__init__.py").read_text(encoding="utf-8"))) or ""
    prose = "\n".join(line for line in text.splitlines() if not LISTED.match(line))
    page = [f"# {dotted}", "", prose, "", "| module | |", "| --- | --- |"]
    for name, is_package, says in listed(package):
        target = f"{package.name}/{name}.md" if is_package else f"#{dotted}.{name}"
        shown = f"`{name}`" if name.startswith("__") else f"[`{name}`]({target})"
        page.append(f"| {shown} | {says.replace('|', chr(92) + '|')} |")
    if names := re_exported(package):
        page += ["", f"`from {dotted} import ...` gives " + ", ".join(f"[`{n}`][{m}.{n}]" for n, m in names) + "."]
    page += [f"\n::: {dotted}.{name}\n" for name, is_package, _ in listed(package) if not is_package and name[0] != "_"]
    return "\n".join(page)


def without_docstring(root: Path) -> Iterator[str]:
    """Yield `file:line: name` of every public name without a docstring.

    A method that calls the same method of `super()` and a stub of a protocol have that of their base.
    """

    def below(node: ast.Module | ast.ClassDef, where: str) -> Iterator[str]:
        for found in node.body:
            if not isinstance(found, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) or found.name[0] == "_":
                continue
            inherits = isinstance(node, ast.ClassDef) and (
                f"super().{found.name}(" in ast.unparse(found) or ast.unparse(found.body[-1]) == "..."
            )
            if not inherits and not ast.get_docstring(found):
                yield f"{where}:{found.lineno}: {found.name}"
            if isinstance(found, ast.ClassDef):
                yield from below(found, where)

    for package in packages(root):
        for file in sorted(package.glob("*.py")):
            tree = ast.parse(file.read_text(encoding="utf-8"))
            where = file.relative_to(root).as_posix()
            if not ast.get_docstring(tree):
                yield f"{where}:1: the module"
            yield from below(tree, where)


# --- pages ----------------------------------------------------------------------------------------------------------


def repository_path(src_uri: str) -> str:
    """Return the path in the repository of what the site calls `src_uri`."""
    if src_uri.startswith(f"{REPOSITORY}/"):
        return src_uri.removeprefix(f"{REPOSITORY}/")
    return f"{DOCS}/{src_uri}"


def target_of(link: str, page: str, root: Path) -> tuple[str, str] | None:
    """Return path in the repository and site's path of what a page links to, or None where nothing is there.

    `page` is the page's path in the repository.
    """
    path = posixpath.normpath(posixpath.join(posixpath.dirname(page), link))
    if path.startswith("..") or not (root / path).exists():
        return None
    if path.startswith(f"{DOCS}/"):
        inside = path.removeprefix(f"{DOCS}/")
        return path, f"{inside}/README.md" if (root / path).is_dir() else inside
    package = posixpath.dirname(path) if path.endswith("/__init__.py") else path
    if root / package in packages(root):
        return path, f"{REFERENCE}/{package}.md"
    if path.endswith(".md") or Path(path).suffix in PICTURES:
        return path, f"{REPOSITORY}/{path}"
    return path, f"{REPOSITORY}/{path}.md"


def page_of_file(path: str, root: Path) -> str:
    """Return a page that shows a file of the repository, or lists a folder."""
    place = root / path
    if place.is_dir():
        return f"# {path}\n\nThe files of this folder:\n\n" + "".join(
            f"- `{file.name}`\n" for file in sorted(place.iterdir())
        )
    try:
        text = place.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return f"# {path}\n\nA file of {place.stat().st_size} bytes that is no text.\n"
    fence = "`" * max(3, 1 + max((len(run) for run in re.findall("`+", text)), default=0))
    return f"# {path}\n\n{fence}{LANGUAGES.get(place.suffix, 'text')}\n{text.rstrip()}\n{fence}\n"


def outside_fences(markdown: str, change: Callable[[str], str]) -> str:
    """Return `markdown` with `change` made to each line that is not of a block of code."""
    lines, fence = [], None
    for line in markdown.splitlines():
        if (match := FENCE.match(line)) and (fence is None or line.strip() == fence):
            fence = match[1] if fence is None else None
        elif fence is None:
            line = change(line)
        lines.append(line)
    return "\n".join(lines) + "\n"


def links(markdown: str) -> list[str]:
    """Return the targets of all relative links of a page."""
    found: list[str] = []

    def take(line: str) -> str:
        found.extend(match["target"] for match in LINK.finditer(line))
        return line

    outside_fences(markdown, take)
    return found


def linked(markdown: str, page: str, uri: str, root: Path) -> str:
    """Return a page with its links turned to where the site has what they lead to.

    `page` is its path in the repository, `uri` its path in the site.
    """

    def to_site(match: re.Match[str]) -> str:
        target = target_of(match["target"], page, root)
        if target is None:  # mkdocs says that it leads nowhere
            return match[0]
        return match["before"] + posixpath.relpath(target[1], posixpath.dirname(uri) or ".") + (match["after"] or "")

    return outside_fences(markdown, lambda line: LINK.sub(to_site, line))


def lists_of_four(markdown: str) -> str:
    """Return a page whose lists are indented by four spaces and begin after an empty line.

    Python-Markdown needs both; a repository's pages need neither.
    """
    lines: list[str] = []
    indents: list[int] = []  # of the text of each list that is open
    fence = None
    for line in markdown.splitlines():
        indent = len(line) - len(line.lstrip(" "))
        if fence is None and line.strip():
            while indents and indent < indents[-1]:
                indents.pop()
        inner = line[min(indent, indents[-1] if indents else 0) :]
        if match := FENCE.match(line):
            fence = match[1] if fence is None else None if line.strip() == fence else fence
        marker = None if fence is not None else MARKER.match(inner)
        if marker and not indents and lines and lines[-1].strip() and not IN_LIST.match(lines[-1]):
            lines.append("")
        lines.append("    " * len(indents) + inner if line.strip() else "")
        if marker:
            indents.append((indents[-1] if indents else 0) + len(marker[1]) + len(marker[2]))
    return "\n".join(lines) + "\n"


# --- what a browser would load --------------------------------------------------------------------------------------

LOADS = {
    "script": "src",
    "img": "src",
    "iframe": "src",
    "source": "src",
    "video": "src",
    "audio": "src",
    "link": "href",
}
NO_LOAD = {"canonical", "next", "prev", "alternate"}
"""`rel` of links that tell something and load nothing."""
STYLE_LOADS = re.compile(r"(?:url\(|@import)\s*[\"']?((?:https?:)?//[^)\"'\s]+)")


class Loads(HTMLParser):
    """The addresses that a page makes a browser load."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep the address of whatever this tag loads."""
        values = dict(attrs)
        address = values.get(LOADS.get(tag, ""))
        if address is not None and not (tag == "link" and values.get("rel") in NO_LOAD):
            self.addresses.append(address)


def foreign(site: Path) -> Iterator[str]:
    """Yield `file: address` of all that a browser would load from elsewhere."""
    for file in sorted(site.rglob("*")):
        if file.suffix == ".html":
            page = Loads()
            page.feed(file.read_text(encoding="utf-8"))
            addresses = page.addresses
        elif file.suffix == ".css":
            addresses = STYLE_LOADS.findall(file.read_text(encoding="utf-8"))
        else:
            continue
        yield from (f"{file.relative_to(site)}: {a}" for a in addresses if re.match(r"(?:https?:)?//", a))


# --- hooks ----------------------------------------------------------------------------------------------------------


def _refuse(problems: Iterator[str], what: str) -> None:
    from mkdocs.exceptions import PluginError

    if found := list(problems):
        raise PluginError(f"{what}:\n" + "\n".join(found))


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of reference, and the files of the repository that pages link to."""
    from mkdocs.structure.files import File

    _refuse(without_docstring(CHECKOUT), "public names without a docstring")
    if files.get_file_from_path(FRONT) is None:
        files.append(File.generated(config, FRONT, content=linked(_read("README.md"), "README.md", FRONT, CHECKOUT)))
    files.append(File.generated(config, "style.css", content=STYLE))
    config.extra_css.append("style.css")
    for package in packages(CHECKOUT):
        name = package.relative_to(CHECKOUT).as_posix()
        page = f"{REFERENCE}/{name}.md"
        files.append(File.generated(config, page, content=reference_of(package, CHECKOUT)))
    pages = [(file.src_uri, file.content_string) for file in files.documentation_pages() if _written(file.src_uri)]
    wanted = [(path, f"{REPOSITORY}/{path}") for path in ALWAYS if (CHECKOUT / path).is_file()]
    wanted += _targets(pages)
    while wanted:
        path, uri = wanted.pop()
        if files.get_file_from_path(uri) is not None:
            continue
        if uri == f"{REPOSITORY}/{path}" and not path.endswith(".md"):
            files.append(File.generated(config, uri, abs_src_path=str(CHECKOUT / path)))
            continue
        own = uri == f"{REPOSITORY}/{path}"
        content = _read(path) if own else page_of_file(path, CHECKOUT)
        files.append(File.generated(config, uri, content=content))
        wanted += _targets([(uri, content)]) if own else []
    config.nav = _nav([file.src_uri for file in files.documentation_pages()])
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn the links of a page that people wrote, and indent its lists."""
    uri = page.file.src_uri
    return lists_of_four(linked(markdown, repository_path(uri), uri, CHECKOUT)) if _written(uri) else markdown


def on_post_build(config: MkDocsConfig) -> None:
    """Fail where a browser would load anything from elsewhere."""
    _refuse(foreign(Path(config.site_dir)), "a browser would load from elsewhere")


def _read(path: str) -> str:
    return (CHECKOUT / path).read_text(encoding="utf-8")


def _written(uri: str) -> bool:
    """Return True for a page that people wrote, and False for one that is made here."""
    if uri.startswith(f"{REPOSITORY}/"):
        return (CHECKOUT / repository_path(uri)).suffix == ".md" and (CHECKOUT / repository_path(uri)).is_file()
    return not uri.startswith(f"{REFERENCE}/")


def _targets(pages: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return all that pages link to outside of `docs/`."""
    found = [target_of(link, repository_path(uri), CHECKOUT) for uri, content in pages for link in links(content)]
    return [target for target in found if target is not None and target[1].startswith(f"{REPOSITORY}/")]


def _nav(uris: list[str]) -> list[Any]:
    """Return the order of the pages: guide, decisions, reference, and the repository's own."""
    order = {uri: number for number, uri in enumerate(FIRST)}
    guide = sorted((u for u in uris if "/" not in u), key=lambda uri: (order.get(uri, len(order)), uri))
    folders = sorted({u.split("/")[0] for u in uris if "/" in u} - {REFERENCE, REPOSITORY})
    own = [f"{REPOSITORY}/{path}" for path in ALWAYS if f"{REPOSITORY}/{path}" in uris]
    files = sorted(u for u in uris if u.startswith(f"{REPOSITORY}/") and u not in own)
    return [
        {"Guide": guide},
        *(
            {name.capitalize(): sorted((u for u in uris if u.startswith(f"{name}/")), key=_readme_first)}
            for name in folders
        ),
        {
            "Reference": [
                {uri.removeprefix(f"{REFERENCE}/").removesuffix(".md").replace("/", "."): uri}
                for uri in uris
                if uri.startswith(f"{REFERENCE}/")
            ]
        },
        {"Project": [*own, {"Files": files}] if files else own},
    ]


def _readme_first(uri: str) -> tuple[bool, str]:
    return not uri.endswith(("/README.md", "/index.md")), uri
