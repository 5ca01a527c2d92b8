// Check the page in the present view: faults as [rule, what], its links, its anchors, and what it holds.
// test_browser.py evaluates this; `known` lists the combinations of colours and size whose contrast has been checked.
async (known) => {
  const isFirstView = !window.wasChecked;
  window.wasChecked = true;
  const faults = [];
  const fault = (rule, what) => faults.push([rule, String(what).replace(/\s+/g, " ").trim().slice(0, 200)]);
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const pause = (ms) => new Promise((done) => setTimeout(done, ms));
  const shown = (e) => e.checkVisibility({ visibilityProperty: true, opacityProperty: true });
  const show = (e) => e.outerHTML.slice(0, 120);

  // ---- wait until the page is at rest -------------------------------------------------------------------------
  await new Promise(requestAnimationFrame);  // the page may still have to follow a change of the window
  const wanted = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
  const isLate = () => ![undefined, wanted].includes(document.documentElement.dataset.theme);
  for (let i = 0; i < 40 && isLate(); i++) await pause(50);
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
  for (const move of document.getAnimations()) if (move instanceof CSSTransition) move.finish();

  // ---- the page as a whole ------------------------------------------------------------------------------------
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
  const words = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  const texts = new Set();
  while (words.nextNode()) {
    const node = words.currentNode, parent = node.parentElement;
    if (!node.data.trim()) continue;
    texts.add(parent);
    if (parent.closest(untouched)) continue;
    if (/\\[a-zA-Z]{2,}|\\[()[\]]|\$\$|\$[^\s$][^$]*\$/.test(node.data)) fault("equation", `raw TeX: ${node.data}`);
    if (/`[^`]+`|\*\*\w|\]\(\w/.test(node.data) && !parent.closest("dl.py")) fault("markup", `raw Markdown: ${node.data}`);
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
    if (!isFirstView) continue;
    const before = slider.value;
    button.click();
    for (let i = 0; i < 40 && slider.value === before; i++) await pause(50);
    button.click();
    if (slider.value === before) fault("animation", `does not play: ${show(canvas)}`);
  }

  // ---- names, headings, tables (with axe below) ---------------------------------------------------------------
  for (const e of all("a[href], button, [role=button], summary").filter(shown)) {
    if (/^(here|this|link|click here|this link)\.?$/i.test(e.textContent.trim())) fault("name", `vague: ${show(e)}`);
  }
  const titles = all("h1", document.querySelector("article") || document).filter(shown).length;
  if (titles !== 1) fault("heading", `${titles} headings of the first level`);
  for (const table of all("article table")) {
    if (!table.querySelector("th")) fault("table", `no header: ${table.textContent.slice(0, 80)}`);
  }

  // ---- width --------------------------------------------------------------------------------------------------
  const edge = document.documentElement.clientWidth + 1;
  const scrolls = (e) => /auto|scroll/.test(getComputedStyle(e).overflowX) && e.getBoundingClientRect().right <= edge;
  const inOwnBox = (e) => {
    for (let p = e.parentElement; p && p !== document.body; p = p.parentElement) if (scrolls(p)) return true;
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

  // ---- axe: names, headings, and the contrast of the first and last text of each new kind --------
  const grounds = new Map([[null, ""]]), samples = new Map();
  const ground = (e) => {
    if (!grounds.has(e)) {
      const { backgroundColor, opacity } = getComputedStyle(e), below = ground(e.parentElement);
      const own = backgroundColor === "rgba(0, 0, 0, 0)" && opacity === "1" ? "" : `${backgroundColor} ${opacity} `;
      grounds.set(e, own + below);
    }
    return grounds.get(e);
  };
  for (const e of texts) {
    if (!shown(e) || e.closest(".visually-hidden, [disabled], svg, mjx-assistive-mml")) continue;
    const { color, fontSize, fontWeight } = getComputedStyle(e);
    const kind = [color, fontSize, fontWeight, ground(e)].join(), [first = e] = samples.get(kind) || [];
    samples.set(kind, [first, e]);
  }
  known.forEach((kind) => samples.delete(kind));
  all("[data-sample]").forEach((e) => { delete e.dataset.sample; });
  [...samples.values()].flat().forEach((e) => { e.dataset.sample = ""; });
  axe.configure({ rules: [{ id: "color-contrast", selector: "[data-sample]" }] });
  const rules = {
    "color-contrast": "contrast", "heading-order": "heading", "role-img-alt": "image", "html-has-lang": "page",
    "document-title": "page", "link-name": "name", "button-name": "name", "summary-name": "name", "label": "name",
    "select-name": "name",
  };
  // Names and headings do not depend on the view. Without `preload: false` axe itself requests every style sheet.
  const runOnly = isFirstView ? Object.keys(rules) : samples.size ? ["color-contrast"] : [];
  const options = { runOnly, resultTypes: ["violations"], preload: false };
  const found = runOnly.length ? await axe.run(options) : { violations: [] };
  for (const { id, nodes } of found.violations) {
    nodes.forEach((node) => fault(rules[id], `${id}: ${node.html.slice(0, 120)} ${node.failureSummary}`));
  }

  // ---- links --------------------------------------------------------------------------------------------------
  const links = all("a[href]").map((e) => [e.href, e.getAttribute("href")]);
  const anchors = ids.concat(all("a[name]").map((e) => e.name));
  return {
    faults, links, anchors, theme: document.documentElement.dataset.theme || "light", kinds: [...samples.keys()],
    counts: { equations: equations.length, images: images.length, canvases: all("article canvas").length },
  };
}
