// What Khronos's validator says of a glTF file, as JSON: node validate.js FILE
const { readFileSync } = require("fs");
const { validateBytes } = require("gltf-validator");
const file = process.argv[2];
validateBytes(new Uint8Array(readFileSync(file)), { uri: file }).then((report) => console.log(JSON.stringify(report)));
