// What is wrong with the layout of a page as it is shown now: what is cut, what is wider than the window, what overlaps.
() => {
  const wrong = [];
  const root = document.documentElement;
  if (root.scrollWidth > root.clientWidth) wrong.push(`the page is ${root.scrollWidth} wide in ${root.clientWidth}`);

  // What may be cut, because it moves inside itself, or because its program draws it.
  const moving = (element) => element.closest(".wide, pre, nav.side, .turn");
  const shownPart = (rect, element) => {
    const place = moving(element);
    if (!place) return rect;
    const p = place.getBoundingClientRect();
    const left = Math.max(rect.left, p.left), right = Math.min(rect.right, p.right);
    const top = Math.max(rect.top, p.top), bottom = Math.min(rect.bottom, p.bottom);
    return { left, right, top, bottom, width: right - left, height: bottom - top };
  };
  const brief = (text) => text.trim().replace(/\s+/g, " ").slice(0, 50);

  // The lines of all texts outside of drawings.
  const lines = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const element = node.parentElement;
    if (!node.data.trim() || !element.checkVisibility() || element.closest("script, style, .turn, .skip, svg")) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    for (const whole of range.getClientRects()) {
      if (whole.width < 1 || whole.height < 1) continue;
      if (!moving(element) && (whole.left < -0.5 || whole.right > root.clientWidth + 0.5)) {
        wrong.push(`cut: "${brief(node.data)}" from ${whole.left} to ${whole.right}`);
      }
      const rect = shownPart(whole, element);
      if (rect.width > 1 && rect.height > 1) lines.push({ rect, node, text: node.data });
    }
  }
  const overlaps = (items, what) => {
    items.sort((a, b) => a.rect.top - b.rect.top);
    for (let i = 0; i < items.length; i++) {
      for (let j = i + 1; j < items.length && items[j].rect.top < items[i].rect.bottom - 3; j++) {
        const a = items[i], b = items[j];
        const across = Math.min(a.rect.right, b.rect.right) - Math.max(a.rect.left, b.rect.left);
        const down = Math.min(a.rect.bottom, b.rect.bottom) - Math.max(a.rect.top, b.rect.top);
        if (a.node !== b.node && across > 2 && down > 3) wrong.push(`${what}: "${brief(a.text)}" and "${brief(b.text)}" overlap`);
      }
    }
  };
  overlaps(lines, "text");

  // Figures, pictures, tables and signs stand clear of one another.
  const boxes = [...document.querySelectorAll("figure, .told, pre, .wide:has(> table), section > p, section > ul")]
    .filter((element) => element.checkVisibility() && !element.parentElement.closest("figure"))
    .map((element) => ({ node: element, rect: element.getBoundingClientRect(), text: element.id || element.textContent }));
  overlaps(boxes.filter(({ rect }) => rect.width > 0), "blocks");

  // The words of each figure: inside of it, and clear of one another.
  // In a scene names are where their frames are, some of them at one place.
  for (const svg of document.querySelectorAll("figure :not(.still) > svg")) {
    const frame = svg.getBoundingClientRect();
    if (!frame.width || !svg.checkVisibility()) continue;
    const name = svg.closest("figure").id;
    const words = [...svg.querySelectorAll("text")].map((node) => ({ node, rect: node.getBoundingClientRect(), text: node.textContent }));
    for (const { rect, text } of words) {
      const out = Math.max(frame.left - rect.left, rect.right - frame.right, frame.top - rect.top, rect.bottom - frame.bottom);
      if (out > 4) wrong.push(`${name}: "${brief(text)}" is ${out.toFixed(0)} pixels outside of the figure`);
    }
    // Only upright words: those that are turned fill less than the box around them.
    overlaps(words.filter(({ node }) => { const m = node.getCTM(); return Math.abs(m.b) < 1e-3 * Math.abs(m.a); }), name);
  }
  return [...new Set(wrong)].slice(0, 40);
}
