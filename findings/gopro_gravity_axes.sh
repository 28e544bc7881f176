#!/usr/bin/env bash
# gopro-telemetry 1.2.11 (npm) and a recording of a HERO11 that it contains: the streams of one camera have different axes, and no label tells. ACCL and GYRO are z, x, y (`ORIN`
# of the file), named "Accelerometer" and "Gyroscope"; GRAV, the camera's own direction of gravity, has it on its second axis. At rest, taken as they come, the two differ by 85
# degrees; with ACCL in the order that ORIN states, by 82; as second, first, third number by 1. Of a HERO7 the same reader writes "Accelerometer (z,x,y)" and turns the axes
# itself, as those files also have `ORIO`; of a HERO11 it neither turns nor names them.
# Guessed: three numbers are x, y, z of one frame; at least once ORIN is applied, all vectors of one camera agree.
# Matters here: GoPro cameras are a usual source of video with an IMU. A gravity from GRAV as the first attitude, or as check of the IMU's axes, lays the rig on its side;
# readings without ORIN have their axes permuted. By its maker GRAV is along x, -z, -y; the camera was level, so this run tells the second axis only.
# Source: https://github.com/gopro/gpmf-parser/issues/170 and /165 (its maker on both); code/interpretKLV.js of the package; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-audit --no-fund --no-package-lock gopro-telemetry@1.2.11 >npm.log 2>&1
cat >read.js <<'NODE'
const telemetry = require("gopro-telemetry");
const { readFileSync } = require("fs");
const package_ = "node_modules/gopro-telemetry";
const assert = (right, what) => { if (!right) throw new Error(what); };
const unit = (v) => v.map((x) => x / Math.hypot(...v));
const degrees = (a, b) => (Math.acos(a.reduce((sum, x, i) => sum + x * b[i], 0)) * 180) / Math.PI;
const read = async (name, options) => {
  const timing = { frameDuration: 0.04, start: new Date(0), samples: [{ cts: 0, duration: 1001 }] };
  const rawData = readFileSync(`${package_}/samples/${name}.raw`);
  return telemetry({ rawData, timing }, { stream: ["ACCL", "GYRO", "GRAV"], ...options });
};
(async () => {
  console.log("gopro-telemetry", JSON.parse(readFileSync(`${package_}/package.json`)).version);
  for (const name of ["hero7", "hero11"]) {
    const raw = JSON.stringify(await read(name, { raw: true }));
    const orders = ["ORIN", "ORIO"].map((key) => [...new Set(raw.match(new RegExp(`"${key}":"\\w+"`, "g")))].join());
    const { streams } = Object.values(await read(name)).find((device) => device.streams);
    console.log(`${name}: ${streams.ACCL.name}; ${streams.GYRO.name}; ${orders.join(" ")}`);
    assert(streams.ACCL.name === (name === "hero7" ? "Accelerometer (z,x,y)" : "Accelerometer"), "name");
    if (name === "hero7") continue;
    assert(orders.join() === '"ORIN":"ZXY",', "ORIN without ORIO");
    const gravity = streams.GRAV.samples.map((sample) => unit(sample.value));
    const each = streams.ACCL.samples.length / gravity.length; // readings a frame: 8
    assert(each === 8, "readings a frame");
    const force = gravity.map((_, k) =>
      unit([0, 1, 2].map((i) => streams.ACCL.samples.slice(8 * k, 8 * k + 8).reduce((sum, s) => sum + s.value[i], 0))));
    const show = (v) => v.map((x) => x.toFixed(3)).join(", ");
    console.log(`first frame: ACCL ${show(force[0])}; GRAV ${show(gravity[0])}`);
    const off = {};
    for (const [order, what] of [[[0, 1, 2], "as it comes"], [[1, 2, 0], "by ORIN"], [[1, 0, 2], "second, first, third"]]) {
      const angles = force.slice(0, 200).map((v, k) => degrees(order.map((i) => v[i]), gravity[k]));
      off[what] = angles.reduce((sum, x) => sum + x, 0) / angles.length;
      console.log(`ACCL ${what}: ${off[what].toFixed(1)} degrees from GRAV, mean of ${angles.length} frames at rest`);
    }
    assert(off["as it comes"] > 80 && off["by ORIN"] > 75 && off["second, first, third"] < 3, "axes");
  }
})().catch((error) => { console.error(error); process.exit(1); });
NODE
node read.js | grep -v altitude
