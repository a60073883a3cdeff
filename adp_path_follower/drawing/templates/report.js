"use strict";
(() => {
  window.open = () => null;  // no control of the page may send anything
  const data = JSON.parse(document.getElementById("data").textContent);
  const slider = document.getElementById("time");
  const play = document.getElementById("play");
  const speed = document.getElementById("speed");
  const now = document.getElementById("now");
  const narrow = window.matchMedia("(max-width: 600px)");
  const dark = window.matchMedia("(prefers-color-scheme: dark)");

  // Arrays of numbers come as the bytes of single-precision floats.
  const numbers = (coded) => {
    if (Array.isArray(coded)) return coded.map((value) => (value === null ? NaN : value));
    const bytes = Uint8Array.from(atob(coded.bdata), (letter) => letter.charCodeAt(0));
    return new Float32Array(bytes.buffer);
  };
  const motions = data.motions.map((motion) => ({
    ...motion,
    ...Object.fromEntries(
      ["time", "x", "y", "theta", "target_x", "target_y"].map((key) => [key, numbers(motion[key])]),
    ),
  }));

  const first = Math.min(...motions.map((motion) => motion.time[0]));
  const last = Math.max(...motions.map((motion) => motion.time[motion.time.length - 1]));
  let time = Math.min(Math.max(0, first), last);

  // Between two known poses the robot is moved in proportion.
  const place = (motion, at) => {
    let low = 0;
    let high = motion.time.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (motion.time[middle] <= at) low = middle;
      else high = middle;
    }
    const span = motion.time[high] - motion.time[low];
    const share = span > 0 ? Math.min(1, Math.max(0, (at - motion.time[low]) / span)) : 0;
    const mix = (values) => values[low] + share * (values[high] - values[low]);
    return {
      x: mix(motion.x), y: mix(motion.y), theta: mix(motion.theta),
      targetX: mix(motion.target_x), targetY: mix(motion.target_y),
    };
  };

  const figures = [...document.querySelectorAll("[data-figure]")].map((element) => ({
    element,
    key: element.dataset.figure,
    ...data.figures[element.dataset.figure],
    visible: false,
    stale: false,
  }));
  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  const robots = (figure) => {
    const axis = figure.element._fullLayout?.xaxis;
    const pixel = axis ? Math.abs(axis.range[1] - axis.range[0]) / axis._length : 0.05;
    const size = 20 * pixel;  // the same on the screen at any zoom and width
    return motions.flatMap((motion) => {
      const { x, y, theta, targetX, targetY } = place(motion, time);
      const corner = (angle, length) =>
        `${x + length * size * Math.cos(theta + angle)},${y + length * size * Math.sin(theta + angle)}`;
      const shapes = [{
        type: "path", name: "robot", fillcolor: motion.color, opacity: 0.95,
        line: { color: style("--text"), width: 1 },
        path: `M ${corner(0, 1)} L ${corner(2.5, 0.8)} L ${corner(Math.PI, 0.35)} L ${corner(-2.5, 0.8)} Z`,
      }];
      if (Number.isFinite(targetX) && Number.isFinite(targetY)) {
        const radius = 0.35 * size;
        shapes.push({
          type: "circle", name: "target", line: { color: style("--text"), width: 2 },
          x0: targetX - radius, x1: targetX + radius, y0: targetY - radius, y1: targetY + radius,
        });
      }
      return shapes;
    });
  };
  const shapes = (figure) => {
    const fixed = figure.layout.shapes || [];
    if (figure.key === "track") return [...fixed, ...robots(figure)];
    if (!figure.over_time) return fixed;
    return [...fixed, {
      type: "line", name: "now", xref: "x", yref: "paper", x0: time, x1: time, y0: 0, y1: 1,
      line: { color: style("--link"), width: 1.5 },
    }];
  };

  const theme = () => {
    const axis = { gridcolor: style("--line"), zerolinecolor: style("--line"), linecolor: style("--quiet") };
    const changes = {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", "font.color": style("--text"),
    };
    return { axis, changes };
  };
  // Which markers are coloured by the distance from the path; their colours are the theme's.
  const coloured = (figure) =>
    figure.data.flatMap((trace, index) => (trace.marker?.colorscale ? [index] : []));
  const recolour = (figure) => {
    const traces = coloured(figure);
    if (!traces.length) return;
    Plotly.restyle(figure.element, { "marker.colorscale": [data.scales[dark.matches ? "dark" : "light"]] }, traces);
  };
  const themed = (figure) => {
    const { axis, changes } = theme();
    const all = { ...changes };
    for (const name of Object.keys(figure.element._fullLayout || figure.layout)) {
      if (/^[xy]axis\d*$/.test(name)) {
        for (const [key, value] of Object.entries(axis)) all[`${name}.${key}`] = value;
      }
    }
    return all;
  };

  const draw = async (figure) => {
    const layout = structuredClone(figure.layout);
    const small = narrow.matches;
    layout.font = { family: "system-ui, sans-serif", size: small ? 11 : 13 };
    layout.margin = small ? { l: 52, r: 8, t: 12, b: 44 } : { l: 70, r: 16, t: 12, b: 48 };
    layout.legend = { orientation: "h", yanchor: "bottom", y: 1.01, x: 0 };
    layout.dragmode = small ? false : "zoom";  // a finger scrolls the page
    layout.hoverlabel = { namelength: 40 };
    if (figure.key === "track" && small) {
      layout.height = 420;
      for (const trace of figure.data) {
        if (trace.marker && trace.marker.colorbar) {
          trace.marker.colorbar = {
            ...trace.marker.colorbar,
            title: { text: "|cross-track| [m]", side: "top" }, orientation: "h", y: -0.18, yanchor: "top", thickness: 10,
          };
          layout.margin.b = 96;
        }
      }
    }
    for (const index of coloured(figure)) {
      figure.data[index].marker.colorscale = data.scales[dark.matches ? "dark" : "light"];
    }
    await Plotly.newPlot(figure.element, figure.data, layout, {
      responsive: true, displaylogo: false, scrollZoom: false,
      showSendToCloud: false, plotlyServerURL: "",
      displayModeBar: small ? false : "hover",
    });
    await Plotly.relayout(figure.element, { ...themed(figure), shapes: shapes(figure) });
    figure.element.on("plotly_click", (event) => {
      const point = event.points[0];
      if (figure.over_time) move(Number(point.x));
      else if (figure.key === "track" && point.customdata) move(Number(point.customdata[0]));
    });
    if (figure.key === "track") {
      figure.element.on("plotly_relayout", (change) => {
        if (Object.keys(change).some((name) => name.startsWith("xaxis"))) update(figure);
      });
    }
  };

  const update = (figure) => {
    figure.stale = !figure.visible;
    if (figure.visible) Plotly.relayout(figure.element, { shapes: shapes(figure) });
  };
  const move = (to) => {
    time = Math.min(last, Math.max(first, to));
    slider.value = time;
    slider.setAttribute("aria-valuetext", `${time.toFixed(2)} seconds`);
    now.textContent = `${time.toFixed(2)} s`;
    for (const figure of figures) {
      if (figure.over_time || figure.key === "track") update(figure);
    }
  };

  let started = null;
  const frame = (stamp) => {
    if (started === null) return;
    const step = ((stamp - started) / 1000) * Number(speed.value);
    started = stamp;
    move(time + step);
    if (time >= last) stop();
    else requestAnimationFrame(frame);
  };
  const stop = () => {
    started = null;
    play.textContent = "Play";
    play.setAttribute("aria-pressed", "false");
  };
  play.addEventListener("click", () => {
    if (started !== null) {
      stop();
      return;
    }
    if (time >= last) move(Math.max(0, first));
    play.textContent = "Pause";
    play.setAttribute("aria-pressed", "true");
    started = performance.now();
    requestAnimationFrame(frame);
  });
  document.querySelector(".player").addEventListener("submit", (event) => event.preventDefault());

  slider.min = first;
  slider.max = last;
  slider.addEventListener("input", () => move(Number(slider.value)));
  slider.addEventListener("keydown", (event) => {
    const steps = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10 };
    if (!(event.key in steps)) return;
    event.preventDefault();
    move(time + (steps[event.key] * (last - first)) / 200);
  });
  dark.addEventListener("change", () => {
    for (const figure of figures) {
      Plotly.relayout(figure.element, { ...themed(figure), shapes: shapes(figure) });
      recolour(figure);
    }
  });

  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      const figure = figures.find((item) => item.element === entry.target);
      figure.visible = entry.isIntersecting;
      if (figure.visible && figure.stale) update(figure);
    }
  }, { rootMargin: "100px" });
  (async () => {
    for (const figure of figures) await draw(figure);
    for (const figure of figures) seen.observe(figure.element);
    move(time);
    document.documentElement.dataset.ready = "true";
  })();
})();
