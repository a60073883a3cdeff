"use strict";
(async () => {
  window.open = () => null;  // no control of the page may send anything
  const nonce = document.currentScript.nonce;
  const narrow = window.matchMedia("(max-width: 600px)");
  const wide = window.matchMedia("(min-width: 1100px)");
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  // --- what the page carries, compressed --------------------------------------------------------
  const unpacked = async (id) => {
    const letters = atob(document.getElementById(id).textContent);
    const bytes = new Uint8Array(letters.length);
    for (let place = 0; place < letters.length; place += 1) bytes[place] = letters.charCodeAt(place);
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  };
  if (!("DecompressionStream" in window)) {
    document.getElementById("too-old").hidden = false;
    return;
  }
  const library = document.createElement("script");
  library.nonce = nonce;
  const [code, text] = await Promise.all(["library", "data"].map(unpacked));
  library.textContent = code;
  document.head.append(library);
  const data = JSON.parse(text);

  // Arrays of numbers come as the bytes of single-precision floats.
  const numbers = (coded) => {
    if (Array.isArray(coded)) return coded.map((value) => (value === null ? NaN : value));
    const bytes = Uint8Array.from(atob(coded.bdata), (letter) => letter.charCodeAt(0));
    return new Float32Array(bytes.buffer);
  };
  const motions = (data.motions || []).map((motion) => ({
    ...motion,
    ...Object.fromEntries(
      ["time", "x", "y", "theta", "target_x", "target_y"].map((key) => [key, numbers(motion[key])]),
    ),
  }));
  const shown = (color) => (dark.matches && data.on_dark[color]) || color;
  const first = Math.min(...motions.map((motion) => motion.time[0]));
  const last = Math.max(...motions.map((motion) => motion.time[motion.time.length - 1]));
  let time = Math.min(Math.max(0, first), last);

  // --- the robots -------------------------------------------------------------------------------
  const before = (times, at) => {  // the last index whose time is not later, or 0
    let low = 0;
    let high = times.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= at) low = middle;
      else high = middle;
    }
    return times[high] <= at ? high : low;
  };
  // Between two known poses the robot is moved in proportion.
  const place = (motion, at) => {
    const low = Math.min(before(motion.time, at), motion.time.length - 2);
    const high = low + 1;
    const span = motion.time[high] - motion.time[low];
    const share = span > 0 ? Math.min(1, Math.max(0, (at - motion.time[low]) / span)) : 0;
    const mix = (values) => values[low] + share * (values[high] - values[low]);
    return {
      x: mix(motion.x), y: mix(motion.y), theta: mix(motion.theta),
      targetX: mix(motion.target_x), targetY: mix(motion.target_y),
    };
  };
  // The width of a pixel of the map [m].
  const pixelOf = (figure) => {
    const axis = figure.element._fullLayout?.xaxis;
    return axis ? Math.abs(axis.range[1] - axis.range[0]) / axis._length : 0.05;
  };
  const robots = (figure, pixel = pixelOf(figure)) => {
    const size = 20 * pixel;  // the same on the screen at any zoom and width
    // The first is drawn last, above the others.
    return motions.filter((motion) => motion.time.length > 1).reverse().flatMap((motion) => {
      const { x, y, theta, targetX, targetY } = place(motion, time);
      const corner = (angle, length) =>
        `${x + length * size * Math.cos(theta + angle)},${y + length * size * Math.sin(theta + angle)}`;
      const shapes = [{
        type: "path", name: "robot", fillcolor: shown(motion.color), opacity: 0.95,
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

  // --- the figures ------------------------------------------------------------------------------
  const figures = [...document.querySelectorAll("[data-figure]")].map((element) => ({
    element,
    key: element.dataset.figure,
    ...data.figures[element.dataset.figure],
  }));
  const overTime = figures.filter((figure) => figure.over_time);
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
    return {
      layout: {
        paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: style("--text") },
        hoverlabel: { bgcolor: style("--raised") }, xaxis: axis, yaxis: axis,
        modebar: { bgcolor: style("--raised"), color: style("--quiet"), activecolor: style("--text") },
      },
    };
  };
  // Which markers are coloured by the distance from the path; their colours are the theme's.
  const coloured = (figure) =>
    figure.data.flatMap((trace, index) => (data.scales && trace.marker?.colorscale ? [index] : []));
  const scale = () => data.scales[dark.matches ? "dark" : "light"];
  // The colours of curves, markers and swatches are those of the light theme until they are painted.
  const PAINTED = { "line.color": ["line"], "marker.color": ["marker"], "marker.line.color": ["marker", "line"] };
  const painted = (trace) => {
    trace.own ||= Object.fromEntries(Object.entries(PAINTED).map(
      ([name, way]) => [name, way.reduce((part, step) => part?.[step], trace)?.color],
    ).filter(([, color]) => typeof color === "string"));
    return Object.fromEntries(Object.entries(trace.own).map(([name, color]) => [name, shown(color)]));
  };
  const paint = (figure) => {
    for (const trace of figure.data) {
      for (const [name, color] of Object.entries(painted(trace))) {
        PAINTED[name].reduce((part, step) => part[step], trace).color = color;
      }
    }
  };
  const swatches = [...document.querySelectorAll(".swatch")].map((element) => [element, element.dataset.color]);
  const paintSwatches = () => swatches.forEach(([element, color]) => { element.style.background = shown(color); });

  const beside = ({ element }) => wide.matches && element.closest(".first")?.children.length > 2;
  const ONE_LINE = 30;  // [px] of a legend
  const heightOf = (figure) => {
    if (beside(figure)) return 400;
    return figure.key === "track" && narrow.matches ? 420 : figure.layout.height;
  };
  const layoutOf = (figure) => {
    const layout = structuredClone(figure.layout);
    const small = narrow.matches;
    layout.template = theme();
    layout.shapes = shapes(figure);
    layout.height = heightOf(figure);
    layout.font = { family: "system-ui, sans-serif", size: small ? 11 : 13 };
    layout.margin = small || beside(figure) ? { l: 64, r: 8, t: 12, b: 48 } : { l: 92, r: 16, t: 12, b: 52 };
    layout.legend = { orientation: "h", yanchor: "bottom", y: 1.01, x: 0, tracegroupgap: 0, maxheight: 5000 };
    layout.dragmode = small ? false : "zoom";  // a finger scrolls the page
    layout.hoverlabel = { namelength: 40 };
    if (figure.over_time && figure.key !== "events") {
      layout.hovermode = "x unified";  // one label for all curves at a time
      layout.hoversubplots = "axis";
    }
    if (figure.key === "track" && small) {
      for (const { marker } of figure.data) {
        if (!marker?.colorbar) continue;
        Object.assign(marker.colorbar, { orientation: "h", y: -0.22, yanchor: "top", thickness: 10, len: 0.85 });
        marker.colorbar.title.side = "top";
        layout.margin.b = 104;
      }
    }
    return layout;
  };
  const draw = async (figure) => {
    for (const index of coloured(figure)) figure.data[index].marker.colorscale = scale();
    paint(figure);
    await Plotly.newPlot(figure.element, figure.data, layoutOf(figure), {
      responsive: true, displaylogo: false, scrollZoom: false,
      showSendToCloud: false, plotlyServerURL: "",
      modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
      displayModeBar: narrow.matches ? false : "hover",
    });
    figure.drawn = true;
    // A legend takes no height from the curves, however many lines it has.
    const { _height: legend } = figure.element._fullLayout.legend || {};
    if (legend > ONE_LINE) await Plotly.relayout(figure.element, { height: heightOf(figure) + legend - ONE_LINE });
    if (figure.over_time && span) await zoom(figure);
    else if (figure.key === "track") update(figure);  // the robot's size, as the scale is known now
    figure.element.on("plotly_click", (event) => {
      const point = event.points[0];
      if (figure.over_time) move(Number(point.x));
      else if (figure.key === "track" && point.customdata) move(Number(point.customdata[0]));
    });
    figure.element.on("plotly_relayout", (change) => {
      if (figure.over_time) zoomAll(change);
      else if (figure.key === "track" && !follow?.checked && Object.keys(change).some((name) => name.startsWith("xaxis"))) update(figure);
    });
  };

  // --- zoom: one axis of time for all figures, and the vertical axes follow ---------------------
  const axisName = (short) => short.replace(/^([xy])/, "$1axis");
  const verticalRanges = (figure, span) => {
    const found = {};
    for (const trace of figure.element._fullData) {
      if (trace.meta === "behind") continue;
      const name = axisName(trace.yaxis || "y");
      const axis = figure.element._fullLayout[name];
      if (!["linear", "log"].includes(axis.type) || !trace.x) continue;
      const range = (found[name] ||= [Infinity, -Infinity]);
      for (let index = 0; index < trace.x.length; index += 1) {
        const value = axis.type === "log" ? Math.log10(trace.y[index]) : trace.y[index];
        if (trace.x[index] < span[0] || trace.x[index] > span[1] || !Number.isFinite(value)) continue;
        range[0] = Math.min(range[0], value);
        range[1] = Math.max(range[1], value);
      }
    }
    const changes = {};
    for (const [name, [low, high]] of Object.entries(found)) {
      if (low > high) continue;
      const room = 0.06 * (high - low) || 0.05 * Math.abs(high) || 1;
      changes[`${name}.range`] = [low - room, high + room];
    }
    return changes;
  };
  let zooming = false;
  let span = null;  // that all figures show [s]; null is everything
  const zoom = (figure) => {
    const changes = { "xaxis.range": [...(span || figure.layout.xaxis.range)] };
    if (span) Object.assign(changes, verticalRanges(figure, span));
    else if (figure.key !== "events") {
      for (const name of Object.keys(figure.element._fullLayout)) {
        if (!/^yaxis\d*$/.test(name)) continue;
        const range = figure.layout[name]?.range;
        if (range) changes[`${name}.range`] = [...range];
        else changes[`${name}.autorange`] = true;
      }
    }
    return Plotly.relayout(figure.element, changes);
  };
  const zoomAll = async (change) => {
    if (zooming || !Object.keys(change).some((name) => name.startsWith("xaxis."))) return;
    zooming = true;
    const low = change["xaxis.range[0]"];
    span = (low === undefined ? change["xaxis.range"] : [low, change["xaxis.range[1]"]]) || null;
    for (const figure of overTime) {
      if (figure.drawn) await zoom(figure);
    }
    zooming = false;
  };

  // --- time -------------------------------------------------------------------------------------
  const NEAR = 2;  // [m] that the map shows at least
  const follow = document.getElementById("follow");
  const slider = document.getElementById("time");
  const play = document.getElementById("play");
  const speed = document.getElementById("speed");
  const now = document.getElementById("now");
  const update = (figure) => {
    figure.stale = !(figure.visible && figure.drawn);
    if (figure.stale) return;
    if (figure.key === "track" && follow.checked) followRobots(figure);
    else Plotly.relayout(figure.element, { shapes: shapes(figure) });
  };
  // The part of the map around all robots.
  const followRobots = (figure) => {
    const places = motions.map((motion) => place(motion, time)).filter(({ x, y }) => Number.isFinite(x + y));
    if (!places.length) return;
    const { xaxis, yaxis } = figure.element._fullLayout;
    const extent = (values) => [0.5 * (Math.min(...values) + Math.max(...values)), Math.max(...values) - Math.min(...values)];
    const [x, across] = extent(places.map((found) => found.x));
    const [y, along] = extent(places.map((found) => found.y));
    const pixel = Math.max((NEAR + 1.3 * across) / xaxis._length, (NEAR + 1.3 * along) / yaxis._length);
    const range = (middle, axis) => [middle - 0.5 * pixel * axis._length, middle + 0.5 * pixel * axis._length];
    const fixed = figure.layout.shapes || [];
    Plotly.relayout(figure.element, {
      "xaxis.range": range(x, xaxis), "yaxis.range": range(y, yaxis), shapes: [...fixed, ...robots(figure, pixel)],
    });
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
  const stop = () => {
    started = null;
    play.textContent = "Play";
    play.setAttribute("aria-pressed", "false");
  };
  const frame = (stamp) => {
    if (started === null) return;
    const step = ((stamp - started) / 1000) * Number(speed.value);
    started = stamp;
    move(time + step);
    if (time >= last) stop();
    else requestAnimationFrame(frame);
  };
  const toggle = () => {
    if (started !== null) {
      stop();
      return;
    }
    if (time >= last) move(Math.max(0, first));
    play.textContent = "Pause";
    play.setAttribute("aria-pressed", "true");
    started = performance.now();
    requestAnimationFrame(frame);
  };
  const stepBy = (samples) => {
    const times = motions[0].time;
    const place = before(times, time + 1e-6);
    move(times[Math.min(times.length - 1, Math.max(0, place + samples))]);
  };
  const STEPS = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 };
  const onKey = (event) => {
    const onSlider = event.target === slider;
    const elsewhere = event.target.closest("select, button, summary, a, .scroll, [type=checkbox]");
    if (event.altKey || event.ctrlKey || event.metaKey || (elsewhere && !onSlider)) return;
    if (event.key === " ") toggle();
    else if (onSlider && event.key.startsWith("Page")) {
      move(time + ((event.key === "PageUp" ? 1 : -1) * (last - first)) / 20);
    } else if (event.key in STEPS && (onSlider || /Left|Right/.test(event.key))) stepBy(STEPS[event.key]);
    else return;
    event.preventDefault();
  };
  const startPlayer = () => {
    play.addEventListener("click", toggle);
    document.querySelector(".player").addEventListener("submit", (event) => event.preventDefault());
    slider.min = first;
    slider.max = last;
    slider.addEventListener("input", () => move(Number(slider.value)));
    follow.addEventListener("change", () => {
      const figure = figures.find((item) => item.key === "track");
      const { xaxis, yaxis } = figure.layout;
      if (follow.checked) update(figure);
      else Plotly.relayout(figure.element, { "xaxis.range": [...xaxis.range], "yaxis.range": [...yaxis.range] });
    });
    document.addEventListener("keydown", onKey);
  };

  // --- tables that sort -------------------------------------------------------------------------
  const sortBy = (table, column, header) => {
    const up = header.getAttribute("aria-sort") !== "ascending";
    const body = table.tBodies[0];
    const value = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent;
    const rows = [...body.rows].sort((a, b) => {
      const [one, other] = [Number(value(a)), Number(value(b))];
      if (Number.isNaN(one) || Number.isNaN(other)) {
        const known = Number.isNaN(one) - Number.isNaN(other);  // what is not known comes last
        return known || (up ? 1 : -1) * value(a).localeCompare(value(b));
      }
      return (up ? 1 : -1) * (one - other);
    });
    for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
    header.setAttribute("aria-sort", up ? "ascending" : "descending");
    body.append(...rows);
  };
  for (const table of document.querySelectorAll("table.sorts")) {
    [...table.tHead.rows[0].cells].forEach((header, column) => {
      header.querySelector("button")?.addEventListener("click", () => sortBy(table, column, header));
    });
  }

  // --- begin ------------------------------------------------------------------------------------
  paintSwatches();
  dark.addEventListener("change", () => {
    paintSwatches();
    for (const figure of figures.filter((item) => item.drawn)) {
      Plotly.relayout(figure.element, { template: theme(), shapes: shapes(figure) });
      figure.data.forEach((trace, index) => {
        const changes = painted(trace);
        if (Object.keys(changes).length) Plotly.restyle(figure.element, changes, [index]);
      });
      const traces = coloured(figure);
      if (traces.length) Plotly.restyle(figure.element, { "marker.colorscale": [scale()] }, traces);
    }
  });
  for (const figure of figures) figure.element.style.minHeight = `${heightOf(figure)}px`;
  const begun = (figure) => (figure.begun ||= draw(figure));
  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      const figure = figures.find((item) => item.element === entry.target);
      figure.visible = entry.isIntersecting;
      if (figure.visible) begun(figure).then(() => figure.stale && update(figure));
    }
  }, { rootMargin: "100px" });
  // The first screen is ready before the figures below it are drawn, one after the other.
  for (const figure of figures) {
    figure.visible = figure.element.getBoundingClientRect().top < window.innerHeight;
    if (figure.visible) await begun(figure);
  }
  if (motions.length) {
    startPlayer();
    move(time);
  }
  document.documentElement.dataset.ready = "true";
  const idle = window.requestIdleCallback || setTimeout;
  for (const figure of figures) seen.observe(figure.element);
  for (const figure of figures) {
    await new Promise((resolve) => idle(resolve));
    await begun(figure);
  }
  document.documentElement.dataset.drawn = "true";
})();
