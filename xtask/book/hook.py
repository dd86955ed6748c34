"""The pages, navigation and anchors of the book, each as a forge has them.

A page keeps its path in the repository, so that its links are right as they stand. The tables of docs/README.md are
the navigation; MkDocs warns of a page that is in none of them.
"""

import posixpath
import re
import subprocess
from pathlib import Path
from xml.etree import ElementTree

from markdown.extensions import Extension
from markdown.util import AtomicString
from markdown_it import MarkdownIt
from mkdocs.exceptions import PluginError
from mkdocs.plugins import event_priority, get_plugin_logger
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
HOME = "docs/README.md"
# The manual's first page is the book's, so the repository's own is not.
RENAMED = {HOME: "index.html", "README.md": "README.html"}
LINK = re.compile(r"\]\(([^)#\s]+)")
LOADED = re.compile(r"<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)=\"?(?:https?:)?//[^>]*>")

log = get_plugin_logger("book")
# How often each anchor of the page in work was there.
anchors = {}


def on_config(config):
    config.nav = navigation((ROOT / HOME).read_text("utf-8"))
    config.markdown_extensions[:] = ["toc", AsOnAForge()]
    config.mdx_configs["toc"] = {"slugify": anchor}
    # It would need a server.
    config.theme.static_templates.discard("404.html")
    return config


def navigation(home):
    """The parts of the manual's first page, each with the pages in the first column of its table."""
    parts, pages = [{"The manual": HOME}], []
    for line in home.splitlines():
        if line.startswith("## "):
            pages = []
            parts.append({line[3:]: pages})
        elif line.startswith("|"):
            targets = LINK.findall(line.split("|")[1])
            pages += [beside(HOME, target) for target in targets if target.endswith(".md")]
    return parts


def on_files(files, config):
    """Takes every Markdown file that git knows or would add, and each file that one of them leads to."""
    git = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md"]
    known = subprocess.run(git, cwd=ROOT, stdout=subprocess.PIPE, text=True).stdout.splitlines()
    pages = [page for page in known if (ROOT / page).is_file()]
    if not pages:
        raise PluginError("git knows no page here: run it in a checkout")
    led_to = [beside(page, target) for page in pages for target in LINK.findall((ROOT / page).read_text("utf-8"))]
    paths = sorted({*pages, *(path for path in led_to if (ROOT / path).is_file())})
    of_theme = [file for file in files if file.src_dir != config.docs_dir]
    return Files(
        of_theme + [File(path, str(ROOT), config.site_dir, False, dest_uri=RENAMED.get(path)) for path in paths]
    )


def beside(page, target):
    """The path from the root of what a page calls `target`."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), target))


class AsOnAForge(Extension):
    """CommonMark and tables instead of Python-Markdown's own rules, which lose some lists and blocks of code."""

    reader = MarkdownIt("commonmark").enable("table")

    def extendMarkdown(self, md):
        md.preprocessors.deregister("html_block")
        md.treeprocessors.deregister("inline")
        md.parser = self

    def parseDocument(self, lines):
        html = self.reader.render("\n".join(lines))
        try:
            tree = ElementTree.fromstring(f"<div>{html}</div>")
        except ElementTree.ParseError as error:
            raise PluginError(f"HTML within Markdown has to be well-formed: {error}") from error
        for element in tree.iter():
            element.text = element.text and AtomicString(element.text)
            element.tail = element.tail and AtomicString(element.tail)
        return ElementTree.ElementTree(tree)


def on_page_markdown(markdown, **_):
    anchors.clear()
    return markdown


def anchor(heading, separator):
    """The anchor that a forge gives a heading, as in `anchors` of xtask/src/manual.rs."""
    name = re.sub(r"[^\w-]", "", heading.strip().lower().replace(" ", separator))
    before = anchors.get(name, 0)
    anchors[name] = before + 1
    return f"{name}-{before}" if before else name


def on_page_content(html, **_):
    """Lets a table scroll within itself."""
    return html.replace("<table>", '<div class="wide"><table>').replace("</table>", "</table></div>")


def on_post_page(output, page, **_):
    """Warns of each thing that a page would load from the network."""
    for element in LOADED.findall(output):
        log.warning("%s loads from elsewhere: %s", page.file.src_uri, element)
    return output


@event_priority(-100)
def on_post_build(config):
    """Turns the texts that the search plugin has left into a script: a page cannot read JSON without a server."""
    folder = Path(config.site_dir, "search")
    texts = (folder / "search_index.json").read_text("utf-8")
    (folder / "index.js").write_text(f"const book_index = {texts};\n", "utf-8")
    for unused in ("search_index.json", "worker.js"):
        (folder / unused).unlink()
