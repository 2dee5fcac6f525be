"""Pages are short, and so are their sentences."""

import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[3]
DOCS = ROOT / "docs"
MADE_FROM_CODE = {
    DOCS / name for name in ("benchmarks.md", "numbers.md", "paper.md", "settings.md")
}
PAGES = [
    ROOT / "README.md",
    *(
        page
        for page in sorted(DOCS.rglob("*.md"))
        if page not in MADE_FROM_CODE and not page.is_relative_to(DOCS / "reference")
    ),
]
MOST_WORDS = 45_000
LONGEST_SENTENCE = 40

CODE_OR_COMMENT = re.compile(r"```.*?```|<!--.*?-->", re.DOTALL)
LINK = re.compile(r"!?\[([^]]*)\]\([^)]*\)")
BLOCK = re.compile(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.|#+)\s)|\n(?=\s*\|)|\|")
SENTENCE_END = re.compile(r"(?<=[.!?])[\"')*`]*\s+")


def sentences(page: str) -> Iterator[str]:
    """Those of paragraphs, headings, items of lists and cells of tables."""
    text = LINK.sub(r"\1", CODE_OR_COMMENT.sub("\n\n", page))
    for block in BLOCK.split(text):
        yield from SENTENCE_END.split(block)


def test_sentences_are_found_in_all_parts_of_a_page() -> None:
    page = (
        "# A title\n\nOne [link](to.md) here. Two\nlines.\n- item\n\n| a | b. c |\n```\ncode\n```"
    )
    found = [" ".join(sentence.split()) for sentence in sentences(page)]
    expected = ["# A title", "One link here.", "Two lines.", "- item", "a", "b.", "c"]
    assert [sentence for sentence in found if sentence] == expected


def test_no_sentence_is_too_long() -> None:
    long = [
        (str(page.relative_to(ROOT)), " ".join(sentence.split()))
        for page in PAGES
        for sentence in sentences(page.read_text(encoding="utf-8"))
        if len(sentence.split()) > LONGEST_SENTENCE
    ]
    assert long == []


def test_all_pages_can_be_read_in_an_afternoon() -> None:
    words = {
        str(page.relative_to(ROOT)): len(page.read_text(encoding="utf-8").split()) for page in PAGES
    }
    assert sum(words.values()) <= MOST_WORDS, words
