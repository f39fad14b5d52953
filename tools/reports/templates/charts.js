// Draws the charts of the page with Chart.js from the data beside them.
'use strict';
(() => {
  const digits = (value) => Number(value).toPrecision(5).replace(/\.?0+($|e)/, '$1');
  const withUnit = (name, unit) => (unit ? `${name} (${unit})` : name);

  // the phases of a run as bands behind its curves
  const bands = {
    id: 'bands',
    beforeDatasetsDraw(chart, _, options) {
      const {ctx, chartArea: area, scales: {x}} = chart;
      for (const [, begin, end, colour] of options.list || []) {
        const left = Math.max(x.getPixelForValue(begin), area.left), right = Math.min(x.getPixelForValue(end), area.right);
        ctx.fillStyle = colour;
        if (right > left) ctx.fillRect(left, area.top, right - left, area.bottom - area.top);
      }
    },
  };

  const axis = (name, unit, more) => ({
    type: 'linear', title: {display: Boolean(name), text: withUnit(name, unit)}, ticks: {maxRotation: 0, autoSkipPadding: 12, includeBounds: false},
    grid: {color: (line) => (line.tick && line.tick.value === 0 ? '#777777' : '#dddddd')}, ...more,
  });

  const settings = (data) => {
    const curves = data.curves, bar = data.kind === 'bar';
    const several = curves.length > 1;
    const hover = (item) => {
      const curve = curves[item.datasetIndex], words = curve.words && curve.words[item.dataIndex];
      if (bar) return `${digits(item.parsed.x)} ${data.xUnit}`;
      const what = several ? curve.label : data.y;
      const at = data.hover === 'x' ? '' : `; ${data.x} ${digits(item.parsed.x)} ${data.xUnit}`;
      return `${what}: ${digits(item.parsed.y)} ${data.yUnit}${at}${words ? `; ${words}` : ''}`;
    };
    return {
      type: bar ? 'bar' : 'line',
      data: {
        labels: bar ? curves[0].y : undefined,
        datasets: curves.map((c) => ({
          label: c.label, data: bar ? c.x : c.x.map((x, i) => ({x, y: c.y[i]})), borderColor: c.colour, backgroundColor: c.colour,
          borderDash: c.dash, borderWidth: bar ? 0 : 1.8, pointRadius: c.marks ? 1.8 : 0, pointHitRadius: 8, pointHoverRadius: 4,
          stepped: c.stepped ? 'after' : false, spanGaps: false, maxBarThickness: 22,
        })),
      },
      options: {
        animation: false, responsive: true, maintainAspectRatio: false, indexAxis: bar ? 'y' : 'x',
        interaction: data.hover === 'x' ? {mode: 'nearest', axis: 'x', intersect: false} : {mode: 'nearest', intersect: false},
        scales: bar ? {x: axis(data.x, data.xUnit), y: {type: 'category', grid: {display: false}}} : {
          x: axis(data.x, data.xUnit, {min: data.shades && data.shades.length ? Math.min(...curves.map((c) => c.x[0])) : undefined,
                                       max: data.shades && data.shades.length ? Math.max(...curves.map((c) => c.x[c.x.length - 1])) : undefined,
                                       beginAtZero: Boolean(data.from_zero)}),
          y: axis(data.y, data.yUnit, data.shades ? {afterFit: (scale) => { scale.width = Math.max(scale.width, 72); }} : {}), // one time axis below another
        },
        plugins: {
          legend: {display: several || Boolean(data.legend), labels: {usePointStyle: true, pointStyle: 'line'}},
          bands: {list: data.shades},
          tooltip: {
            callbacks: {
              title: (items) => (bar ? items[0] && items[0].label : data.hover === 'x' && items.length ? `${data.x} ${digits(items[0].parsed.x)} ${data.xUnit}` : ''),
              label: hover,
            },
          },
        },
      },
      plugins: [bands],
    };
  };

  Chart.defaults.font.family = 'system-ui, sans-serif';
  Chart.defaults.color = '#333333';
  const charts = [];
  for (const source of document.querySelectorAll('script[data-chart]')) {
    charts.push(new Chart(document.getElementById(source.dataset.chart), settings(JSON.parse(source.textContent))));
  }
  // paper has another width
  window.addEventListener('beforeprint', () => charts.forEach((chart) => chart.resize()));
  window.addEventListener('afterprint', () => charts.forEach((chart) => chart.resize()));
})();
