// The search: in the page itself, because a worker and its requests need a server.
// Looks with lunr into MkDocs' texts, which hook.py leaves in search/index.js as `book_index`.
document.addEventListener("DOMContentLoaded", function () {
    "use strict";
    const MOST = 30; // results shown
    const BEFORE = 80; // letters of a text before its first hit
    const LENGTH = 240; // letters of a text
    const query = document.getElementById("mkdocs-search-query");
    const list = document.getElementById("mkdocs-search-results");
    let ready; // a promise of what `load` returns

    function script(name) {
        return new Promise(function (resolve, reject) {
            const element = document.createElement("script");
            element.src = `${base_url}/search/${name}`;
            element.onload = resolve;
            element.onerror = reject;
            document.head.append(element);
        });
    }

    async function load() {
        await Promise.all([script("lunr.js"), script("index.js")]);
        const separator = new RegExp(book_index.config.separator);
        const places = new Map(book_index.docs.map((place) => [place.location, place]));
        lunr.tokenizer.separator = separator;
        const index = lunr(function () {
            this.ref("location");
            this.field("title", { boost: 5 });
            this.field("text");
            // A whole page is there a second time, chapter by chapter.
            book_index.docs.filter((place) => place.location.includes("#")).forEach((place) => this.add(place));
        });
        return { index, places, separator };
    }

    // The chapters that have every word, or begin of a word; the best first.
    function find(index, words) {
        let found;
        for (const word of words) {
            const hits = index.query(function (either) {
                either.term(word, { boost: 10 });
                either.term(word, { wildcard: lunr.Query.wildcard.TRAILING, usePipeline: false });
            });
            const before = found;
            found = new Map();
            for (const { ref, score } of hits) {
                if (!before || before.has(ref)) found.set(ref, score + (before?.get(ref) ?? 0));
            }
        }
        return [...found].sort((one, other) => other[1] - one[1]).map(([location]) => location);
    }

    function element(name, text) {
        const made = document.createElement(name);
        made.textContent = text;
        return made;
    }

    function excerpt(text, words) {
        const letters = words.map((word) => word.replace(/[^\p{L}\p{N}_]/gu, "\\$&")).join("|");
        const first = text.search(new RegExp(letters, "i"));
        const start = text.lastIndexOf(" ", Math.max(first - BEFORE, 0)) + 1;
        const shown = element("p", start > 0 ? "… " : "");
        const parts = text.slice(start, start + LENGTH).split(new RegExp(`(${letters})`, "i"));
        shown.append(...parts.map((part, at) => (at % 2 ? element("mark", part) : part)), " …");
        return shown;
    }

    async function search() {
        ready ??= load();
        const { index, places, separator } = await ready;
        const words = query.value.toLowerCase().split(separator).filter(Boolean);
        const found = words.length > 0 ? find(index, words) : [];
        list.replaceChildren();
        for (const location of found.slice(0, MOST)) {
            const place = places.get(location);
            const page = places.get(location.split("#")[0]);
            const link = element("a", place.title);
            link.href = `${base_url}/${location}`;
            const heading = element("h5", "");
            heading.append(link, page.title === place.title ? "" : element("small", ` ${page.title}`));
            list.append(heading, excerpt(place.text, words));
        }
        if (found.length > MOST) list.append(element("p", `The best ${MOST} of ${found.length}.`));
        if (words.length > 0 && found.length === 0) list.append(element("p", list.dataset.noResultsText));
    }

    query.addEventListener("focus", search);
    query.addEventListener("input", search);
    query.form.addEventListener("submit", function (event) {
        event.preventDefault();
        list.querySelector("a")?.click();
    });
});
