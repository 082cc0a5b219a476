// Keeps the page current, filters while a person types, and updates texts like "3m ago". Without
// this script all links and the filter still work.
"use strict";

const content = () => document.getElementById("page");
const live = document.getElementById("live");
const field = document.getElementById("q");
let shown = "";
let asked = 0;

// Replaces the content by the server's newest. Keeps the focus, scroll positions and open details.
async function show(address, isQuiet) {
  const turn = ++asked;
  const answer = await fetch(address, { headers: { Accept: "text/html" } });
  const text = await answer.text();
  if (turn !== asked || text === shown) return;
  const next = new DOMParser().parseFromString(text, "text/html");
  const fresh = next.getElementById("page");
  if (!fresh) throw new Error("this is not the page");
  shown = text;
  const kept = where(document.activeElement);
  const open = new Set([...content().querySelectorAll("details[open]")].map(place));
  const scrolled = [...content().querySelectorAll(".scroll")].map((one) => [one.scrollLeft, one.scrollTop]);
  for (const one of fresh.querySelectorAll("details")) if (open.has(place(one))) one.open = true;
  content().replaceWith(document.adoptNode(fresh));
  document.title = next.title;
  for (const link of document.querySelectorAll("header nav a, header .brand")) {
    const same = [...next.querySelectorAll("header nav a, header .brand")].find((one) => one.textContent === link.textContent);
    if (same) link.setAttribute("href", same.getAttribute("href"));
  }
  content().querySelectorAll(".scroll").forEach((one, n) => scrolled[n] && one.scrollTo(...scrolled[n]));
  if (kept) find(kept)?.focus({ preventScroll: true });
  if (!isQuiet) say("updated");
}

// Describes the focused element, so that find() can find it in the new content.
function where(element) {
  if (!element || !content().contains(element)) return null;
  const same = element.id ? [] : [...content().querySelectorAll(element.tagName)].filter((one) => key(one) === key(element));
  return { id: element.id, tag: element.tagName, key: key(element), number: same.indexOf(element) };
}

function find(kept) {
  if (kept.id) return document.getElementById(kept.id);
  return [...content().querySelectorAll(kept.tag)].filter((one) => key(one) === kept.key)[kept.number];
}

const key = (one) => one.getAttribute("href") || one.getAttribute("aria-label") || one.textContent.slice(0, 80);
const place = (one) => (one.closest("section, aside, figure")?.querySelector("h2, strong")?.textContent || "") + one.querySelector("summary")?.textContent;

function say(text) {
  if (!live) return;
  live.textContent = text;
  live.classList.toggle("away", text.startsWith("not current"));
  live.classList.toggle("current", /^(live|updated)$/.test(text));
}

// Writes a duration like span() in model/config/base_model.py: 3h20m
function span(seconds) {
  const units = [[86400, "d"], [3600, "h"], [60, "m"], [1, "s"]], left = Math.floor(Math.abs(seconds));
  const place = units.findIndex(([size]) => left >= size || size === 1);
  const [size, unit] = units[place], [smaller, name] = units[place + 1] ?? [];
  const whole = Math.floor(left / size), rest = smaller && whole < 10 ? Math.floor(left % size / smaller) : 0;
  return `${whole}${unit}${rest ? `${rest}${name}` : ""}`;
}

function age() {
  const now = Date.now();
  for (const one of document.querySelectorAll("time[datetime]")) {
    const seconds = (now - Date.parse(one.dateTime)) / 1000;
    const wanted = seconds > -1 ? `${span(seconds)} ago` : `in ${span(seconds)}`;
    if (one.textContent !== wanted) one.textContent = wanted;
  }
}

// Each event names the version of the data. The page may have been made from an earlier version, so
// even the first event may bring news.
let version = live?.dataset.version;

function follow() {
  const events = new EventSource("/events");
  events.addEventListener("change", ({ data }) => {
    if (data !== version) {
      show(location.href, false)
        .then(() => { version = data; })
        .catch(() => say("not current: the server sends no page"));
    }
    if (!live.textContent.startsWith("updated")) say("live");
  });
  events.addEventListener("error", () => {
    say("not current: waiting for the server");
    version = ""; // another server counts anew
    // The browser reconnects by itself, except after an answer that is no stream of events, such as
    // a proxy's error page.
    if (events.readyState === EventSource.CLOSED) setTimeout(follow, 2000);
  });
}

if (field) {
  let timer = 0;
  field.addEventListener("input", () => {
    clearTimeout(timer);
    timer = setTimeout(() => {
      if (["/demand", "/release"].includes(location.pathname)) return;
      const address = new URL(location.href);
      if (field.value) address.searchParams.set("q", field.value);
      else address.searchParams.delete("q");
      address.searchParams.delete("page");
      history.replaceState(null, "", address);
      show(address, true).catch(() => say("not current: the server sends no page"));
    }, 150);
  });
  document.addEventListener("keydown", (event) => {
    if (event.key === "/" && !/^(INPUT|TEXTAREA|SELECT)$/.test(document.activeElement.tagName)) {
      event.preventDefault();
      field.focus();
    }
  });
}
if (live?.dataset.live === "yes") follow();
else say("an earlier state");
setInterval(age, 5000);
