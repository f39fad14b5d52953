// The moving surface of a run: three.js on the numbers of 8 and 16 bits beside it.
'use strict';
(() => {
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const short = (value) => Number(value.toPrecision(3)).toString();

  const show = (source) => {
    const id = source.dataset.surfaceOf, data = JSON.parse(source.textContent);
    const part = (name) => document.getElementById(`${id}-${name}`);
    const canvas = part('view');
    let renderer;
    try {
      const context = canvas.getContext('webgl', {antialias: true, preserveDrawingBuffer: true}); // kept for print
      if (!context) throw new Error('no WebGL');
      renderer = new THREE.WebGLRenderer({canvas, context, antialias: true});
    } catch (error) {
      canvas.hidden = true;
      part('none').hidden = false;
      return;
    }

    const index = data.wide ? new Uint32Array(bytes(data.index)) : new Uint16Array(bytes(data.index));
    const rest = new Uint16Array(bytes(data.rest)), moved = new Int16Array(bytes(data.moved));
    const paint = data.quantities.map((q) => ({...q, colours: new Uint8Array(bytes(q.colours)), values: new Uint8Array(bytes(q.values))}));
    // z of the lung is up: y of the scene
    const place = new Float32Array(3 * index.length), colour = new Float32Array(3 * index.length);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute('position', new THREE.BufferAttribute(place, 3));
    geometry.setAttribute('color', new THREE.BufferAttribute(colour, 3));
    const scene = new THREE.Scene();
    scene.background = new THREE.Color('#ffffff');
    scene.add(new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({vertexColors: THREE.VertexColors, side: THREE.DoubleSide})));
    scene.add(new THREE.AmbientLight('#ffffff', 0.75));
    const camera = new THREE.PerspectiveCamera(35, 1, data.extent / 100, data.extent * 20);
    const lamp = new THREE.DirectionalLight('#ffffff', 0.35);
    scene.add(camera);
    camera.add(lamp);

    let highest = [0, 0, 0];
    for (let i = 0; i < rest.length; ++i) highest[i % 3] = Math.max(highest[i % 3], rest[i]);
    const middle = data.low.map((low, k) => low + highest[k] / 65535 * data.extent / 2);

    const controls = new THREE.OrbitControls(camera, canvas);
    controls.enableKeys = false;
    controls.enableZoom = false; // the wheel scrolls the page until the picture is chosen
    canvas.addEventListener('pointerdown', () => { canvas.focus(); controls.enableZoom = true; });
    canvas.addEventListener('blur', () => { controls.enableZoom = false; });

    const draw = () => renderer.render(scene, camera);
    const front = () => {
      camera.position.set(0, 0.15 * data.extent, 2.15 * data.extent);
      controls.target.set(0, 0, 0);
      controls.update();
      draw();
    };

    const update = () => {
      const frame = Number(part('time').value), factor = Number(part('factor').value), q = paint[Number(part('quantity').value)];
      for (let i = 0; i < index.length; ++i) {
        const corner = 3 * index[i], at = 3 * (frame * data.corners) + corner;
        const p = [0, 1, 2].map((k) => data.low[k] + rest[corner + k] / 65535 * data.extent + factor * moved[at + k] * data.step - middle[k]);
        place[3 * i] = -p[0];    // the right of the body on the left, as one stands before it
        place[3 * i + 1] = p[2];
        place[3 * i + 2] = p[1];
        const shade = 3 * q.values[frame * data.triangles + Math.floor(i / 3)];
        for (let k = 0; k < 3; ++k) colour[3 * i + k] = q.colours[shade + k] / 255;
      }
      geometry.attributes.position.needsUpdate = true;
      geometry.attributes.color.needsUpdate = true;
      geometry.computeVertexNormals();
      geometry.computeBoundingSphere();
      part('now').textContent = `${data.times[frame]} s`;
      part('time').setAttribute('aria-valuetext', `${data.times[frame]} s`);
      part('low').textContent = `${short(q.low)} ${q.unit}`;
      part('high').textContent = `${short(q.high)} ${q.unit}`;
      const pen = part('bar').getContext('2d');
      for (let i = 0; i < 256; ++i) {
        pen.fillStyle = `rgb(${q.colours[3 * i]}, ${q.colours[3 * i + 1]}, ${q.colours[3 * i + 2]})`;
        pen.fillRect(i, 0, 1, 1);
      }
      draw();
    };

    const fit = () => {
      const width = canvas.parentElement.clientWidth;
      if (!width) return;
      const height = Math.round(Math.min(width * 0.75, 480));
      renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
      renderer.setSize(width, height);
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
      draw();
    };

    let playing = 0;
    const stop = () => { clearInterval(playing); playing = 0; part('play').textContent = 'Play'; };
    part('play').addEventListener('click', () => {
      if (playing) { stop(); return; }
      part('play').textContent = 'Stop';
      playing = setInterval(() => {
        part('time').value = (Number(part('time').value) + 1) % data.times.length;
        update();
      }, Math.max(80, 3000 / data.times.length));
    });
    for (const name of ['time', 'quantity', 'factor']) part(name).addEventListener('input', update);
    part('front').addEventListener('click', front);
    controls.addEventListener('change', draw);
    canvas.addEventListener('keydown', (event) => {
      const around = new THREE.Spherical().setFromVector3(camera.position);
      const turn = {ArrowLeft: [-0.15, 0, 1], ArrowRight: [0.15, 0, 1], ArrowUp: [0, -0.12, 1], ArrowDown: [0, 0.12, 1], '+': [0, 0, 0.9], '-': [0, 0, 1.1]}[event.key];
      if (!turn) return;
      event.preventDefault();
      around.theta += turn[0];
      around.phi += turn[1];
      around.radius *= turn[2];
      around.makeSafe();
      camera.position.setFromSpherical(around);
      controls.update();
      draw();
    });
    new ResizeObserver(fit).observe(canvas.parentElement);
    update();
    fit();
    front();
  };

  document.querySelectorAll('script[data-surface-of]').forEach(show);
})();
