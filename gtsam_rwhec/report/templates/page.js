"use strict";
(() => {
  const INK = "#010203"; // what is drawn in this colour takes that of the page's text
  const root = document.documentElement;
  const all = (selector) => [...document.querySelectorAll(selector)];
  const colour = (name) => getComputedStyle(root).getPropertyValue(name).trim();
  root.classList.add("js");

  // The contents: the section in view is marked, and the folded list closes behind a click.
  const links = all("nav a");
  const inView = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      if (!isIntersecting) continue;
      for (const link of links) {
        if (link.hash === `#${target.id}`) link.setAttribute("aria-current", "true");
        else link.removeAttribute("aria-current");
      }
    }
  }, { rootMargin: "-15% 0px -80% 0px" });
  for (const section of all("section")) inView.observe(section);
  for (const link of all(".fold a")) link.addEventListener("click", () => link.closest("details").removeAttribute("open"));

  // Only what moves inside itself is a stop for the keyboard.
  const stops = () => {
    for (const place of all(".wide, pre")) {
      const moves = place.scrollWidth > place.clientWidth + 1 || place.scrollHeight > place.clientHeight + 1;
      if (moves) place.tabIndex = 0;
      else place.removeAttribute("tabindex");
    }
  };
  addEventListener("resize", stops);
  document.addEventListener("toggle", stops, true);
  stops();

  // On paper everything is open.
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = all("main details:not([open])");
    for (const folded of opened) folded.open = true;
  });
  addEventListener("afterprint", () => {
    for (const folded of opened) folded.open = false;
  });

  // Tables sort by a column, by the numbers themselves where it has such; a second click turns the order round.
  for (const table of all("table[data-sorts]")) {
    const headings = [...table.querySelectorAll("thead th")];
    const valueOf = (row, column) => {
      const cell = row.cells[column];
      const number = cell.querySelector("data");
      if (!number) return cell.textContent.trim();
      return number.value === "null" ? Infinity : Number(number.value);
    };
    const order = (a, b) => (typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b), undefined, { numeric: true }));
    headings.forEach((heading, column) => {
      const button = heading.querySelector(".sort");
      button.disabled = false;
      button.addEventListener("click", () => {
        const sign = heading.getAttribute("aria-sort") === "ascending" ? -1 : 1;
        for (const other of headings) other.removeAttribute("aria-sort");
        heading.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
        const body = table.tBodies[0];
        body.append(...[...body.rows].sort((a, b) => sign * order(valueOf(a, column), valueOf(b, column))));
      });
    });
  }

  // Copy. Pages from disk have no clipboard in some browsers: there the text is selected and copied as if by hand.
  const copied = async (place) => {
    try {
      await navigator.clipboard.writeText(place.textContent);
      return "Copied.";
    } catch {
      getSelection().selectAllChildren(place);
      return document.execCommand("copy") ? "Copied." : "The text is selected: copy it with Ctrl+C.";
    }
  };
  for (const button of all("[data-copy]")) {
    button.addEventListener("click", async () => {
      button.nextElementSibling.textContent = await copied(document.getElementById(button.dataset.copy));
    });
  }

  // Figures as files: black on white.
  const save = (url, name) => {
    const link = document.createElement("a");
    link.href = url;
    link.download = name;
    link.click();
  };
  const fileOf = (svg) => {
    const copy = svg.cloneNode(true);
    const { width, height } = svg.viewBox.baseVal;
    copy.setAttribute("xmlns", "http://www.w3.org/2000/svg");
    copy.setAttribute("width", width);
    copy.setAttribute("height", height);
    copy.setAttribute("style", "background: #ffffff; color: #000000");
    return { text: new XMLSerializer().serializeToString(copy).replaceAll("currentColor", "#000000"), width, height };
  };
  const saveSvg = (svg, name) => {
    const url = URL.createObjectURL(new Blob([fileOf(svg).text], { type: "image/svg+xml" }));
    save(url, `${name}.svg`);
    setTimeout(() => URL.revokeObjectURL(url), 10000);
  };
  const savePng = async (svg, name) => {
    const { text, width, height } = fileOf(svg);
    const image = new Image();
    image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(text)}`;
    await image.decode();
    const canvas = document.createElement("canvas");
    const scale = 200 / 72; // pixels a point
    canvas.width = Math.round(scale * width);
    canvas.height = Math.round(scale * height);
    const context = canvas.getContext("2d");
    context.fillStyle = "#ffffff";
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.drawImage(image, 0, 0, canvas.width, canvas.height);
    save(canvas.toDataURL("image/png"), `${name}.png`);
  };
  for (const button of all("[data-save]")) {
    button.addEventListener("click", () => {
      const figure = button.closest("figure");
      const { name } = figure.dataset;
      const form = button.dataset.save;
      if (figure.classList.contains("turns")) {
        window.Plotly.downloadImage(figure.querySelector(".turn"), { format: form, filename: name, scale: form === "png" ? 2 : 1 });
      } else if (form === "svg") saveSvg(figure.querySelector(".svg svg"), name);
      else savePng(figure.querySelector(".svg svg"), name);
    });
  }

  // Scenes in 3D. plotly is in the page, compressed; where it cannot run, the still picture stays, with the reason.
  const packed = document.getElementById("plotly");
  if (!packed) return;
  const scenes = all(".drawing");
  const tell = (figure, words) => { figure.querySelector(".how").textContent = words; };
  const has3d = () => {
    const canvas = document.createElement("canvas");
    return Boolean(canvas.getContext("webgl2") || canvas.getContext("webgl"));
  };
  const unpacked = async () => {
    if (!has3d()) throw new Error("it has no WebGL, or it is switched off");
    if (!window.DecompressionStream) throw new Error("it is older than 2023");
    const bytes = Uint8Array.from(atob(packed.textContent.trim()), (c) => c.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  const config = { responsive: true, displaylogo: false, displayModeBar: false, showLink: false, plotlyServerURL: "",
                   showSendToCloud: false, showEditInChartStudio: false };
  const sceneOf = (figure) => {
    const json = document.getElementById(figure.querySelector(".turn").dataset.scene).textContent;
    const { traces, layout } = JSON.parse(json.replaceAll(INK, colour("--ink")));
    const axis = { color: colour("--quiet"), gridcolor: colour("--line"), zerolinecolor: colour("--line"), showbackground: false };
    const scene = { ...layout.scene, uirevision: "keep" };
    for (const name of ["xaxis", "yaxis", "zaxis"]) scene[name] = { ...axis, ...scene[name] };
    const font = { ...layout.font, color: colour("--ink"), family: getComputedStyle(document.body).fontFamily };
    return [traces, { ...layout, scene, font, uirevision: "keep", paper_bgcolor: colour("--paper"), plot_bgcolor: colour("--paper") }];
  };
  const draw = (figure) => window.Plotly.react(figure.querySelector(".turn"), ...sceneOf(figure), config);
  unpacked().then(async (text) => {
    const script = document.createElement("script");
    script.textContent = text;
    document.head.append(script);
    for (const figure of scenes) {
      figure.classList.add("turns");
      await draw(figure);
      tell(figure, "Drag to turn, scroll or pinch to come nearer, double-click to return.");
    }
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => scenes.forEach(draw));
    root.dataset.scenes = "drawn";
  }).catch((error) => {
    for (const figure of scenes) {
      figure.classList.remove("turns");
      tell(figure, `This is a still picture. This browser cannot turn it: ${error.message}.`);
    }
    root.dataset.scenes = "still";
  });
})();
