// Opens a recording in Rerun's viewer and has it stand at a step, paused. The body's data say which files and step.
(() => {
  const { program, files, timeline, step } = document.body.dataset;
  const said = document.getElementById("said");
  const TRIES = 600, STILL_FRAMES = 3, PAUSE_MS = 100, LOOK_MS = 1000, PAUSED = 1;

  // It writes tens of thousands of lines about its shaders.
  console.debug = () => undefined;

  // It asks for its newest version and sends statistics. The page's policy forbids both; here they do not even start,
  // and wait for ever, so that no errors cover those that matter.
  const ask = window.fetch.bind(window);
  window.fetch = (what, how) =>
    new URL(what instanceof Request ? what.url : what, location.href).origin === location.origin
      ? ask(what, how)
      : new Promise(() => undefined);

  // The viewer is told and asked in protobuf (viewer_control.proto of rerun 0.41). Of what it can be told,
  // set_time_cursor is number 6, in which 1 is the recording, 2 the timeline, 3 the time and 5 the play state.
  const number = (value) => (value < 128 ? [value] : [(value % 128) + 128, ...number(Math.floor(value / 128))]);
  const part = (field, bytes) => [field * 8 + 2, ...number(bytes.length), ...bytes];
  const count = (field, value) => [field * 8, ...number(value)];
  const name = part(1, [...new TextEncoder().encode(timeline)]);
  const place = [...part(2, name), ...part(3, count(1, Number(step))), ...count(5, PAUSED)];
  const standStill = (recording) => new Uint8Array(part(6, [...part(1, [...recording]), ...place]));

  // The fields of a message by their numbers: integers, and bytes of all that has a length.
  function fields(bytes = []) {
    const found = {};
    let at = 0;
    const next = () => {
      let value = 0;
      for (let scale = 1; ; scale *= 128) {
        const byte = bytes[at++];
        value += (byte % 128) * scale;
        if (!(byte >= 128)) return value;
      }
    };
    while (at < bytes.length) {
      const key = next(), value = next(), length = key % 8 ? value : 0;
      (found[Math.floor(key / 8)] ??= []).push(length ? bytes.subarray(at, at + length) : value);
      at += length;
    }
    return found;
  }

  // The id of the recording as soon as its timeline has arrived, and whether it stands still at the step: of the state,
  // 3 is the list of recordings; of a recording 2 its timelines, 3 the place on one of them and 5 the play state.
  function look(viewer) {
    const called = (bytes) => new TextDecoder().decode(fields(fields(bytes)[1]?.[0])[1]?.[0]);
    const recordings = (fields(viewer.viewer_state())[3] ?? []).map((each) => fields(each));
    const found = recordings.find((each) => (each[2] ?? []).some((line) => called(line) === timeline));
    const cursor = found?.[3]?.[0];
    const time = fields(fields(cursor)[3]?.[0])[1]?.[0] ?? 0;
    const stands = cursor && called(cursor) === timeline && time === Number(step) && found[5]?.[0] === PAUSED;
    return { recording: found?.[1]?.[0], stands };
  }

  const pause = (ms) => new Promise((done) => setTimeout(done, ms));
  const frame = () => new Promise((done) => requestAnimationFrame(done));

  // What the server has; if it refuses, it says why in a sentence.
  async function fetched(url) {
    const answer = await ask(url).catch(() => {
      throw new Error("The server does not answer: start it again, then reload the page.");
    });
    if (!answer.ok) throw new Error((await answer.text()).trim());
    return answer;
  }

  // The bytes of a file; null if there is none.
  async function bytes(url) {
    const answer = await fetched(url);
    return answer.status === 204 ? null : new Uint8Array(await answer.arrayBuffer());
  }

  function load(url) {
    return new Promise((done, failed) => {
      const script = document.createElement("script");
      script.src = url;
      script.onload = done;
      script.onerror = () => failed(new Error("The viewer's program cannot be loaded: reload the page."));
      document.head.append(script);
    });
  }

  // Once is not enough: the layout, when it arrives, moves the time to the first step.
  async function stand(viewer) {
    for (let turn = 0, still = 0; still < STILL_FRAMES; turn++) {
      if (turn === TRIES) throw new Error("The viewer does not open this recording: reload the page.");
      const { recording, stands } = look(viewer);
      still = stands ? still + 1 : 0;
      if (recording && !stands) await viewer.viewer_control(standStill(recording)).catch(() => undefined);
      await (recording ? frame() : pause(PAUSE_MS));
    }
  }

  // The first failure tells why; those that it brings about do not.
  function fail(error) {
    if (document.body.dataset.state === "failed") return;
    document.body.dataset.state = "failed";
    said.textContent = error instanceof Error && error.message ? error.message : String(error);
  }

  async function started(wasm) {
    try {
      await wasm_bindgen({ module_or_path: wasm });
      const viewer = new wasm_bindgen.WebHandle({
        url: [], hide_welcome_screen: true, enable_history: false, persist: false, notebook: false,
      });
      window.spherlocViewer = viewer;
      await viewer.start(document.getElementById("viewer"));
      return viewer;
    } catch (error) {
      throw new Error(`Rerun's viewer cannot start in this browser (${error.message ?? error}): try another one.`);
    }
  }

  async function watch(viewer) {
    while (!viewer.has_panicked()) await pause(LOOK_MS);
    fail(`Rerun's viewer has crashed (${viewer.panic_message()}): reload the page.`);
  }

  async function open() {
    const [run, ...others] = files.split(" ").map(bytes);
    // What comes late must not be reported as an unhandled error.
    for (const other of others) other.catch(() => undefined);
    const [first, wasm] = await Promise.all([run, fetched(`${program}re_viewer_bg.wasm`)]);
    await load(`${program}re_viewer.js`);
    const viewer = await started(wasm);
    watch(viewer);
    const complaints = [];
    const show = (id, content) => {
      viewer.open_channel(id, id);
      viewer.send_rrd_to_channel(id, content);
      viewer.close_channel(id);
    };
    show("run", first);
    for (const [place, other] of others.entries()) {
      const content = await other.catch((error) => void complaints.push(error.message));
      if (content) show(`layer ${place + 1}`, content);
    }
    await stand(viewer);
    if (document.body.dataset.state === "failed") return;
    said.textContent = complaints.join(" ");
    said.addEventListener("click", () => (said.textContent = ""));
    document.body.dataset.state = "open";
  }

  open().catch(fail);
})();
