"use strict";
(() => {
  // Copy buttons.
  for (const button of document.querySelectorAll("[data-copy]")) {
    button.addEventListener("click", async () => {
      await navigator.clipboard.writeText(document.getElementById(button.dataset.copy).textContent);
      button.textContent = "Copied";
    });
  }
  // The script of plotly is in the page, compressed.
  const packed = document.getElementById("plotly");
  if (!packed) return;
  const bytes = Uint8Array.from(atob(packed.textContent.trim()), (c) => c.charCodeAt(0));
  const unpacked = new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  unpacked.then((text) => {
    const script = document.createElement("script");
    script.textContent = text;
    document.head.append(script);
    for (const place of document.querySelectorAll("[data-scene]")) {
      const scene = JSON.parse(document.getElementById(place.dataset.scene).textContent);
      window.Plotly.newPlot(place, scene.traces, scene.layout, { responsive: true, displaylogo: false });
    }
  });
})();
