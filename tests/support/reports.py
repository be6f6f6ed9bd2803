"""Reading a report: by the standard library's HTML parser, which shares nothing with what wrote it."""

from html.parser import HTMLParser

VOID = {"meta", "img", "link", "br", "input", "hr"}
FETCHING = {"src", "href", "srcset", "poster", "data", "action", "formaction", "xlink:href", "background"}
OWN = ("data:image/png;base64,", "data:image/svg+xml;base64,", "#")


class Page(HTMLParser):
    """Texts, headings, all digits of the numbers, images, its content security policy, what it would fetch or run, and
    whether tags are balanced."""

    def __init__(self, text: str):
        super().__init__()
        self.source, self.open = text, []
        self.texts, self.headings, self.numbers, self.images, self.tags = [], [], [], [], set()
        self.foreign: list[str] = []
        self.policy = ""
        self.feed(text)
        self.close()
        assert self.open == [], self.open
        if "@import" in text or "url(" in text:
            self.foreign.append("a style that fetches")

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        given = dict(attrs)
        if tag == "meta" and given.get("http-equiv") == "Content-Security-Policy":
            self.policy = given["content"]
        if tag in ("script", "link", "iframe", "object", "embed", "base") or any(name[:2] == "on" for name in given):
            self.foreign.append(self.get_starttag_text())
        for name in FETCHING & set(given):
            if not given[name].startswith(OWN):
                self.foreign.append(given[name])
        if tag == "img":
            self.images.append(given["src"])
        if tag == "data":
            self.numbers.append(given["value"])
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open, tag
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.texts.append(data)
            if self.open[-1] in ("h1", "h2", "h3"):
                self.headings.append(data)
