// node search.cjs SITE < queries (JSON): prints what the site's own search worker answers to each, as JSON
const fs = require("fs"), path = require("path"), vm = require("vm");
const site = process.argv[2], workers = path.join(site, "assets/javascripts/workers");
const [script] = fs.readdirSync(workers).filter((name) => /^search\..*\.js$/.test(name));
const answers = [];
let listener;
const scope = { console, URL, addEventListener: (_, f) => (listener = f), postMessage: (message) => answers.push(message) };
scope.self = scope;
vm.runInNewContext(fs.readFileSync(path.join(workers, script), "utf8"), scope);
const index = JSON.parse(fs.readFileSync(path.join(site, "search/search_index.json"), "utf8"));
const settled = () => new Promise((done) => setImmediate(done));
(async () => {
  listener({ data: { type: 0, data: { ...index, options: { suggest: true } } } });
  await settled();
  const results = {};
  for (const query of JSON.parse(fs.readFileSync(0, "utf8"))) {
    listener({ data: { type: 2, data: query } });
    await settled();
    results[query] = answers.at(-1).data.items.map((page) => page.map((section) => section.location));
  }
  process.stdout.write(JSON.stringify(results));
})();
