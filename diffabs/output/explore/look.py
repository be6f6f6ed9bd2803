"""Style sheet of the page, and the script that runs in the browser."""

from diffabs.output.explore.path_chart import ELEMENT_RATIO

STYLE = """
body { background: #F3F5F7; color: #1F2933; font-family: 'Inter', 'Roboto', system-ui, sans-serif; font-size: 13px; }
.nicegui-content { padding: 0; gap: 0; }
.waiting { margin: 40vh auto; color: #767676; font-size: 15px; }
.explorer { width: 100vw; height: 100vh; display: flex; flex-direction: column; overflow: hidden; }
.explorer header { display: flex; align-items: center; gap: 8px; padding: 0 14px; height: 44px; background: white;
  border-bottom: 1px solid #DDE2E6; flex: none; }
.explorer header .q-btn { padding: 2px 12px; min-height: 28px; }
.brand { font-weight: 700; font-size: 16px; color: #0072B2; }
.brand.thin { font-weight: 400; color: #52606D; margin-left: -3px; }
.grow { flex: 1; }
.latency { color: #7B8794; font-size: 12px; margin-right: 10px; font-variant-numeric: tabular-nums; }
.columns { flex: 1; display: grid; grid-template-columns: 318px minmax(320px, 1fr) 318px; gap: 10px; padding: 10px;
  min-height: 0; }
.columns > section { background: white; border: 1px solid #DDE2E6; border-radius: 6px; min-height: 0; overflow: auto; }
.left, .right { padding: 10px 12px; display: flex; flex-direction: column; gap: 6px; }
.rows { display: flex; flex-direction: column; gap: 6px; }
.left .group { margin-top: 3px; margin-bottom: -4px; }
.left > *, .right > * { flex: none; }
.middle { display: flex; flex-direction: column; padding: 8px 6px 4px 6px; overflow: hidden !important; }
.title { font-weight: 600; font-size: 14px; padding: 0 12px; overflow: hidden; text-overflow: ellipsis;
  white-space: nowrap; }
.curves { flex: 1; min-height: 0; }
.fill { width: 100%; height: 100%; }
.path.nicegui-echart { width: 100%; height: auto; aspect-ratio: RATIO; flex: none; }
.preparing { margin: 30vh auto 0; max-width: 420px; text-align: center; color: #52606D; line-height: 1.5; }
.foot { display: flex; gap: 12px; color: #52606D; font-size: 12px; padding: 0 12px 2px; }
.group { font-size: 11px; font-weight: 600; color: #7B8794; letter-spacing: .04em; text-transform: uppercase;
  margin-top: 6px; }
.knob { display: grid; grid-template-columns: minmax(0, 1fr) 84px 62px; column-gap: 6px; align-items: center; }
.knob .name { white-space: nowrap; overflow: hidden; text-overflow: ellipsis; }
.knob .unit { color: #7B8794; font-size: 12px; white-space: nowrap; overflow: hidden; text-overflow: ellipsis; }
.knob .q-slider { grid-column: 1 / 4; height: 18px; padding: 0 7px; }
.knob .q-slider__track-container--h { padding: 8px 0; }
.knob .q-field__control, .spread .q-field__control { height: 24px !important; min-height: 24px !important;
  padding: 0 6px !important; }
.knob .q-field__native, .spread .q-field__native { padding: 0 !important; text-align: right; font-size: 12.5px;
  min-height: 22px; font-variant-numeric: tabular-nums; }
.knob .q-field__bottom { display: none; }
.knob .q-field--error .q-field__append, .spread .q-field__append { display: none; }
.knob .q-field--with-bottom, .spread .q-field--with-bottom { padding-bottom: 0; }
.spread { display: grid; grid-template-columns: minmax(0, 1fr) 62px 20px; column-gap: 6px; align-items: center; }
.refused { background: #FDECEA; color: #9B1C1C; border: 1px solid #F5B7B1; border-radius: 5px; padding: 6px 8px;
  font-size: 12.5px; line-height: 1.35; }
.card-title { font-weight: 600; font-size: 12.5px; display: flex; gap: 8px; align-items: baseline; }
.busy { color: #B7791F; font-weight: 400; font-size: 11px; }
.verdict { border-radius: 5px; padding: 7px 9px; border-left: 4px solid #9AA5B1; background: #F3F5F7;
  line-height: 1.35; }
.verdict .why { color: #52606D; font-size: 12px; max-height: 84px; overflow: auto; }
.verdict.certified { border-color: #009E73; background: #E8F6F1; }
.verdict.refuted { border-color: #D55E00; background: #FCEFE6; }
.verdict.undecided { border-color: #E69F00; background: #FDF6E3; }
.poles { height: 218px; width: 100%; }
.frequency { height: 220px; width: 100%; }
.right .q-btn-toggle .q-btn { padding: 0 8px; min-height: 20px; font-size: 11.5px; }
.grid-table { display: grid; column-gap: 10px; row-gap: 2px; font-size: 12.5px; font-variant-numeric: tabular-nums; }
.grid-table .head { color: #7B8794; font-size: 11px; }
.grid-table .number { text-align: right; white-space: nowrap; }
.note { color: #7B8794; font-size: 11.5px; line-height: 1.3; }
.stale { opacity: .45; }
.tuning { border: 1px solid #B6D4E8; background: #F2F8FC; border-radius: 5px; padding: 8px; display: flex;
  flex-direction: column; gap: 6px; }
.loss { height: 84px; width: 100%; }
.q-expansion-item .q-item { padding: 0; min-height: 26px; }
.q-expansion-item .q-item__section--avatar { display: none; }
.chooser .q-field__native { font-size: 13px; }
.nicegui-echart { padding: 0; }
""".replace("RATIO", f"{ELEMENT_RATIO:.4f}")

# Measures the latency of the page: from an edit in the browser until a curve of this edit, or a later one, is painted.
# A message posted in requestAnimationFrame arrives after the paint of that frame.
SCRIPT = """
window.explorer = {
  edit: 0, at: {}, times: [], last: 0,
  edited() { this.at[++this.edit] = performance.now(); return this.edit; },
  change(id, option, edit, tries = 500) {
    const chart = getElement(id)?.chart;
    if (!chart) { if (tries) setTimeout(() => this.change(id, option, edit, tries - 1), 20); return; }
    chart.setOption(option);
    if (edit) this.shown(edit);
  },
  shown(edit) {
    requestAnimationFrame(() => { const channel = new MessageChannel();
      channel.port1.onmessage = () => this.painted(edit, performance.now());
      channel.port2.postMessage(0); });
  },
  painted(edit, now) {
    if (!(edit in this.at)) return;
    this.times = [...this.times.slice(-9999), now - this.at[edit]];
    this.last = edit;
    for (const other of Object.keys(this.at)) if (+other <= edit) delete this.at[other];
    const recent = this.times.slice(-25).sort((a, b) => a - b);
    const line = document.querySelector('[data-id=latency]');
    if (line) line.textContent = `redrawn in ${Math.round(recent[recent.length >> 1])} ms`;
  },
};
"""
