// What one page, as it stands in the browser, has to say of itself: faults as [rule, what], its links and its anchors.
// Evaluated in the page by browser.py; the rules are listed in test_browser.py.
async () => {
  const faults = [];
  const fault = (rule, what) => faults.push([rule, String(what).replace(/\s+/g, " ").trim().slice(0, 200)]);
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const pause = (ms) => new Promise((done) => setTimeout(done, ms));
  const shown = (e) => e.checkVisibility({ visibilityProperty: true, opacityProperty: true });
  const show = (e) => e.outerHTML.slice(0, 120);
  const body = document.body;
  const theme = document.documentElement.dataset.theme || "light";

  // ---- wait until the page is at rest -------------------------------------------------------------------------
  const equations = all(".math");
  if (equations.length && window.MathJax && window.MathJax.startup) await window.MathJax.startup.promise;
  all("img[loading=lazy]").forEach((image) => { image.loading = "eager"; });
  const images = all("img");
  const loaded = Promise.all(images.map((image) => image.decode().catch(() => null)));
  await Promise.race([loaded, pause(10000)]);
  await Promise.race([document.fonts.ready, pause(10000)]);
  const moves = document.getAnimations().map((move) => move.finished.catch(() => null));
  await Promise.race([Promise.all(moves), pause(2000)]);
  await pause(50);

  // ---- the page as a whole ------------------------------------------------------------------------------------
  if (!document.documentElement.lang) fault("page", "no language");
  if (!document.title.trim()) fault("page", "no title");
  if (!document.querySelector("link[rel~=icon]")) fault("page", "no icon");
  const ids = all("[id]").map((e) => e.id);
  for (const id of new Set(ids.filter((id, i) => ids.indexOf(id) !== i))) fault("page", `id ${id} twice`);

  // ---- equations ----------------------------------------------------------------------------------------------
  for (const e of equations) {
    if (!e.querySelector("mjx-container")) fault("equation", `not typeset: ${e.textContent}`);
  }
  for (const e of all("mjx-merror, [data-mjx-error]")) {
    fault("equation", `${e.dataset.mjxError || "error"}: ${e.textContent}`);
  }
  const untouched = "code, pre, script, style, noscript, textarea, mjx-container, .math, svg";
  const words = document.createTreeWalker(body, NodeFilter.SHOW_TEXT);
  const texts = [];
  while (words.nextNode()) {
    const node = words.currentNode, parent = node.parentElement;
    if (!node.data.trim() || !parent) continue;
    if (!parent.closest("script, style, noscript, textarea, svg, mjx-assistive-mml")) texts.push(node);
    if (parent.closest(untouched)) continue;
    if (/\\[a-zA-Z]{2,}|\\[()[\]]|\$\$|\$[^\s$][^$]*\$/.test(node.data)) fault("equation", `raw TeX: ${node.data}`);
    if (/`[^`]+`|\*\*\w|\]\(\w/.test(node.data)) fault("markup", `raw Markdown: ${node.data}`);
  }

  // ---- fonts --------------------------------------------------------------------------------------------------
  for (const font of document.fonts) {
    if (font.status === "error") fault("font", `${font.family} did not load`);
  }
  const typeset = [...document.fonts].some((font) => /MJX/.test(font.family) && font.status === "loaded");
  if (equations.length && !typeset) fault("font", "no font of MathJax is loaded");

  // ---- pictures -----------------------------------------------------------------------------------------------
  for (const image of images) {
    if (!image.complete || !image.naturalWidth) fault("image", `not loaded: ${image.getAttribute("src")}`);
    if (!(image.alt || "").trim()) fault("image", `no alt text: ${show(image)}`);
    if (/\.gif$|^data:image\/gif/.test(image.src)) fault("animation", `a gif has no controls: ${show(image)}`);
  }
  for (const e of all("article svg:not([aria-hidden=true]), article canvas")) {
    const named = e.getAttribute("aria-label") || e.getAttribute("aria-labelledby") || e.querySelector("title");
    if (!named && !e.closest("a, button, mjx-container, [aria-hidden=true]")) fault("image", `no words: ${show(e)}`);
  }

  // ---- animations ---------------------------------------------------------------------------------------------
  for (const film of all("video, audio")) {
    const source = film.currentSrc || film.src;
    if (!film.controls) fault("animation", `no controls: ${show(film)}`);
    if (film.readyState < 1) fault("animation", `not loaded: ${show(film)}`);
    if (!film.getAttribute("aria-label") && !film.title) fault("animation", `no words: ${show(film)}`);
    if (source.length > 3e6) fault("animation", `${source.length} bytes`);
  }
  for (const canvas of all("article canvas")) {
    const box = canvas.parentElement;
    const button = box.querySelector("button"), slider = box.querySelector("input[type=range]");
    if (box.outerHTML.length > 3e6) fault("animation", `${box.outerHTML.length} bytes`);
    if (!button || !slider) { fault("animation", `no button or no slider: ${show(canvas)}`); continue; }
    if (button.tabIndex < 0 || slider.tabIndex < 0) fault("animation", "cannot be reached by keyboard");
    const before = slider.value;
    button.click();
    for (let i = 0; i < 40 && slider.value === before; i++) await pause(50);
    button.click();
    if (slider.value === before) fault("animation", `does not play: ${show(canvas)}`);
  }

  // ---- names of what can be pressed, headings, tables ---------------------------------------------------------
  const nameOf = (e) => (e.getAttribute("aria-label") || e.textContent.trim() || e.title || "").trim()
    || all("img[alt], [aria-label], svg title", e).map((x) => x.alt || x.ariaLabel || x.textContent).join(" ").trim();
  for (const e of all("a[href], button, [role=button], summary").filter(shown)) {
    const name = nameOf(e);
    if (!name) fault("name", `no name: ${show(e)}`);
    if (/^(here|this|link|click here|this link)\.?$/i.test(name)) fault("name", `says nothing: ${show(e)}`);
  }
  for (const e of all("input:not([type=hidden]), select, textarea")) {
    const label = e.getAttribute("aria-label") || e.getAttribute("aria-labelledby") || e.title || e.placeholder;
    if (!label && !(e.labels && e.labels.length) && e.type !== "checkbox") fault("name", `no label: ${show(e)}`);
  }
  const headings = all("h1, h2, h3, h4, h5, h6", document.querySelector("article") || body).filter(shown);
  let level = 0;
  for (const heading of headings) {
    const next = Number(heading.tagName[1]);
    if (next > level + 1) fault("heading", `h${next} after h${level}: ${heading.textContent}`);
    level = next;
  }
  const first = headings.filter((e) => e.tagName === "H1").length;
  if (first !== 1) fault("heading", `${first} headings of the first level`);
  for (const table of all("article table")) {
    if (!table.querySelector("th")) fault("table", `no header: ${table.textContent.slice(0, 80)}`);
  }

  // ---- width --------------------------------------------------------------------------------------------------
  const edge = document.documentElement.clientWidth + 1;
  const scrolls = (e) => /auto|scroll/.test(getComputedStyle(e).overflowX) && e.getBoundingClientRect().right <= edge;
  const inOwnBox = (e) => {
    for (let p = e.parentElement; p && p !== body; p = p.parentElement) if (scrolls(p)) return true;
    return false;
  };
  const wide = document.documentElement.scrollWidth;
  if (wide > edge) fault("width", `the page is ${wide} px wide`);
  const inside = (e) => !e.closest("mjx-assistive-mml, .visually-hidden, .tooltip") && !/^mjx-/i.test(e.tagName);
  const beyond = (e) => inside(e) && shown(e) && e.getBoundingClientRect().right > edge + 1 && !inOwnBox(e);
  const out = all("article *").filter(beyond);
  for (const e of out.filter((e) => !out.includes(e.parentElement))) {
    fault("width", `reaches to ${Math.round(e.getBoundingClientRect().right)} px: ${show(e)}`);
  }

  // ---- contrast -----------------------------------------------------------------------------------------------
  const colour = (text) => {
    const parts = (text.match(/[\d.]+/g) || [0, 0, 0, 0]).map(Number);
    const unit = /^color\(srgb/.test(text) ? 255 : 1;
    return [parts[0] * unit, parts[1] * unit, parts[2] * unit, parts.length > 3 ? parts[3] : 1];
  };
  const over = (top, below) => below.map((b, i) => (i < 3 ? top[i] * top[3] + b * (1 - top[3]) : 1));
  const ground = (e) => {
    const layers = [];
    for (let p = e; p; p = p.parentElement) {
      const c = colour(getComputedStyle(p).backgroundColor);
      if (c[3]) layers.push(c);
      if (c[3] === 1) break;
    }
    return layers.reverse().reduce((below, top) => over(top, below), theme === "dark" ? [0, 0, 0, 1] : [255, 255, 255, 1]);
  };
  const light = (c) => {
    const [r, g, b] = c.map((v) => (v / 255 <= 0.04045 ? v / 255 / 12.92 : ((v / 255 + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const contrast = (a, b) => {
    const [high, low] = [light(a), light(b)].sort((p, q) => q - p);
    return (high + 0.05) / (low + 0.05);
  };
  const poor = new Map();
  for (const node of texts) {
    const e = node.parentElement;
    if (!e || !shown(e) || e.closest(".visually-hidden, [disabled], .headerlink, .skip-link")) continue;
    const style = getComputedStyle(e), size = parseFloat(style.fontSize);
    const wanted = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700) ? 3 : 4.5;
    const below = ground(e), ratio = contrast(over(colour(style.color), below), below);
    if (ratio < wanted - 0.05) {
      const key = `${style.color} on ${below.slice(0, 3).map(Math.round)} (${ratio.toFixed(2)})`;
      if (!poor.has(key)) poor.set(key, `${key} <${e.tagName.toLowerCase()} class="${e.className}"> ${node.data.slice(0, 40)}`);
    }
  }
  for (const what of poor.values()) fault("contrast", what);

  // ---- links --------------------------------------------------------------------------------------------------
  const large = all("article img, article canvas").filter((e) => shown(e) && e.getBoundingClientRect().height >= 100);
  const links = all("a[href]").map((e) => [e.href, e.getAttribute("href")]);
  const anchors = ids.concat(all("a[name]").map((e) => e.name));
  return {
    faults, links, anchors, theme,
    picture: large.length ? Math.round(large[0].getBoundingClientRect().bottom + window.scrollY) : null,
    counts: { equations: equations.length, images: images.length, canvases: all("article canvas").length },
  };
}
