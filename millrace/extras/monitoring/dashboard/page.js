// Asks for the main part of this page each second, and changes what has changed. So the place to which the reader has
// scrolled, the focus, opened blocks and chosen values stay as they are.
"use strict";

const EVERY_MS = 1000;
const CHOSEN_BY_THE_READER = ["open", "checked"];
let tag = null;

function merge(old, fresh) {
  if (old.isEqualNode(fresh)) return;
  if (old.nodeType !== fresh.nodeType || old.nodeName !== fresh.nodeName) {
    old.replaceWith(fresh);
    return;
  }
  if (old.nodeType !== Node.ELEMENT_NODE) {
    old.nodeValue = fresh.nodeValue;
    return;
  }
  for (const { name } of [...old.attributes]) {
    if (!fresh.hasAttribute(name) && !CHOSEN_BY_THE_READER.includes(name)) old.removeAttribute(name);
  }
  for (const { name, value } of fresh.attributes) {
    if (!CHOSEN_BY_THE_READER.includes(name) && old.getAttribute(name) !== value) old.setAttribute(name, value);
  }
  const children = [...fresh.childNodes];
  children.forEach((child, i) => {
    const known = child.id && [...old.children].find((each) => each.id === child.id);
    if (known && known !== old.childNodes[i]) old.insertBefore(known, old.childNodes[i] ?? null);
    const here = old.childNodes[i];
    if (!here || (here.id ?? "") !== (child.id ?? "")) old.insertBefore(child, here ?? null);
    else merge(here, child);
  });
  while (old.childNodes.length > children.length) old.lastChild.remove();
}

async function look() {
  if (!document.hidden) {
    let answered = false;
    try {
      const url = new URL(location.href);
      url.searchParams.set("part", "main");
      const headers = tag ? { "If-None-Match": tag } : {};
      const answer = await fetch(url, { headers, cache: "no-store", signal: AbortSignal.timeout(10 * EVERY_MS) });
      if (answer.status === 200) {
        const fresh = new DOMParser().parseFromString(await answer.text(), "text/html").querySelector("main");
        merge(document.querySelector("main"), fresh);
        tag = answer.headers.get("ETag");
      }
      answered = answer.status === 200 || answer.status === 304;
    } catch {}
    document.body.classList.toggle("stale", !answered);
  }
  setTimeout(look, EVERY_MS);
}

setTimeout(look, EVERY_MS);
