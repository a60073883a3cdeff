"use strict";
(() => {
  window.open = () => null;  // no control of the page may send anything
  const data = JSON.parse(document.getElementById("data").textContent);
  const narrow = window.matchMedia("(max-width: 600px)");
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  const themed = (figure) => {
    const small = narrow.matches;
    const layout = structuredClone(figure.layout);
    layout.font = { family: "system-ui, sans-serif", size: small ? 11 : 13, color: style("--text") };
    layout.paper_bgcolor = layout.plot_bgcolor = "rgba(0,0,0,0)";
    layout.margin = small ? { l: 60, r: 8, t: 12, b: 60 } : { l: 90, r: 16, t: 12, b: 60 };
    layout.legend = { orientation: "h", yanchor: "bottom", y: 1.01, x: 0 };
    layout.dragmode = small ? false : "zoom";  // a finger scrolls the page
    for (const name of ["xaxis", "yaxis"]) {
      Object.assign(layout[name], {
        gridcolor: style("--line"), zerolinecolor: style("--line"), linecolor: style("--quiet"),
      });
    }
    return layout;
  };
  const draw = (element) => {
    const figure = data.figures[element.dataset.figure];
    return Plotly.react(element, figure.data, themed(figure), {
      responsive: true, displaylogo: false, scrollZoom: false,
      showSendToCloud: false, plotlyServerURL: "",
      displayModeBar: narrow.matches ? false : "hover",
    });
  };
  const elements = [...document.querySelectorAll("[data-figure]")];
  dark.addEventListener("change", () => elements.forEach(draw));
  (async () => {
    for (const element of elements) await draw(element);
    document.documentElement.dataset.ready = "true";
  })();
})();
