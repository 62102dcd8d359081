// Streams a scene of three points to an Ether Dream with a client that was written elsewhere. Arguments: folder of
// modules, points per second, milliseconds.
import { createRequire } from 'module';

const require = createRequire(`${process.argv[2]}/`);
const { DAC } = require('@laser-dac/core');
const { EtherDream } = require('@laser-dac/ether-dream');

const dac = new DAC();
dac.use(new EtherDream());
if (!(await dac.start())) process.exit(3);
const points = [];
for (let index = 0; index < 300; index += 1) {
  const corner = Math.floor(index / 100);
  points.push({ x: 0.25 * (corner + 1), y: 0.5, r: 0, g: 0, b: index % 100 < 50 ? 1 : 0 });
}
dac.stream({ points }, Number(process.argv[3]));
// Without stop(), after which it writes to the closed connection at times.
setTimeout(() => process.exit(0), Number(process.argv[4]));
