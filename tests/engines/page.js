// What the pages of all engines share: the jobs that the test asks for, and how pixels get back to it.

// Asks for the jobs, has `render(job)` (async, linear RGBA as Float32Array, rows from the top) do each, posts the pixels.
export async function serve(start) {
  try {
    const { render, about } = await start();
    await post("/about", about);
    for (const job of await (await fetch("/jobs")).json()) {
      const pixels = await render(job);
      if (pixels.length !== 4 * job.size * job.size) throw new Error(`${job.name}: ${pixels.length} values`);
      await fetch(`/pixels/${job.name}`, { method: "POST", body: pixels });
    }
    await post("/done", {});
  } catch (error) {
    await post("/failed", { error: String(error?.stack ?? error) });
  }
}

const post = (path, answer) => fetch(path, { method: "POST", body: JSON.stringify(answer) });

addEventListener("error", (event) => post("/failed", { error: `${event.message} ${event.filename}:${event.lineno}` }));
addEventListener("unhandledrejection", (event) => post("/failed", { error: String(event.reason?.stack ?? event.reason) }));

// Runs the steps that `whitefurnace engines` prints, as they are printed: imports, then statements over the names given,
// with the file that they load, 'STEM…', at `url`.
export async function follow(steps, url, given) {
  const lines = steps.map((line) => line.replace(/'STEM[^']*'/, JSON.stringify(new URL(url, location).href)));
  const first = lines.filter((line) => line.startsWith("import ")), rest = lines.filter((line) => !line.startsWith("import "));
  const text = `${first.join("\n")}\nexport async function run(${Object.keys(given)}) {\n${rest.join("\n")}\n}`;
  const module = await import(URL.createObjectURL(new Blob([text], { type: "text/javascript" })));
  await module.run(...Object.values(given));
}

// OpenGL's rows go up.
export function flipped(pixels, size) {
  const out = new Float32Array(pixels.length), row = 4 * size;
  for (let y = 0; y < size; y++) out.set(pixels.subarray(y * row, (y + 1) * row), (size - 1 - y) * row);
  return out;
}
