// Stream as a user of the JavaScript client does, by the scene of the first argument; print what came of it as JSON.

const [, , module, scene, url, token] = process.argv;
const { DisplayStream, Hold, encodeFrame, stop } = await import(module);

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
const print = (value) => console.log(JSON.stringify(value));

async function streamAt(hz, seconds, standing) {
  const stream = new DisplayStream({ url, token, standing });
  const results = [];
  const rates = [];
  stream.onresult = (result) => results.push(result);
  stream.onrate = (rate) => rates.push(rate);
  await stream.ready;
  const begin = performance.now();
  let last = -1;
  for (let sent = 0; sent < hz * seconds; sent += 1) {
    while (performance.now() < begin + (1000 * sent) / hz) await pause(1);
    const all = new Float32Array(437);
    all[17] = all[200] = 60;
    last = stream.send(sent % 2 ? all : { 17: 60, 200: 60 });
  }
  const isOver = () => results.some((each) => each.frame === last && each.status !== "planned");
  while (!isOver()) await pause(5);
  await pause(1100);
  stream.close();
  return { counts: stream.counts, rates, results, last };
}

const scenes = {
  async stream() {
    return streamAt(90, 2, false);
  },
  async hold() {
    const hold = new Hold({ url, token });
    let ended = null;
    hold.onend = (reason) => (ended = reason);
    await hold.armed;
    const streamed = await streamAt(20, 0.5, false);
    await stop({ url, token });
    while (ended === null) await pause(5);
    return { counts: streamed.counts, ended };
  },
  async refused() {
    const refusals = [];
    for (const each of [new DisplayStream({ url, token }).ready, new Hold({ url, token }).armed]) {
      refusals.push(await each.then(() => "accepted", (error) => error.message));
    }
    const state = await stop({ url, token });
    return { refusals, board: state.board.state };
  },
  async wrong() {
    const refusals = [];
    for (const heights of [{ 17: -1 }, { x: 1 }, [1, NaN], { 17: 1e5 }, [1, "2"]]) {
      try {
        encodeFrame(0, heights);
        refusals.push("accepted");
      } catch (error) {
        refusals.push(error.message);
      }
    }
    return { refusals, frame: [...new Uint8Array(encodeFrame(258, [0, 50, 1234.5]))] };
  },
};

print(await scenes[scene]());
process.exit(0);
