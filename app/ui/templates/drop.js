// Dropped files are copied into the first folder in pieces that fit into a request; then the recording opens.
const PIECE = 1 << 19;
const RECORDING = /\.(mcap|bag|db3|pcap|pcapng|hemislam)$/i;
const box = document.querySelector('.hs-drop');
let busy = false;
const show = (html, working) => {
  box.classList.toggle('hs-working', working);
  box.innerHTML = html;
  box.hidden = false;
};
const hide = () => { box.hidden = true; };
const end = (words) => {
  show('<p></p><button class="hs-button">Close</button>', true);
  box.querySelector('p').textContent = words;
  box.querySelector('button').onclick = hide;
};
const carries = (event) => [...(event.dataTransfer?.types || [])].includes('Files');
const ask = async (path, options) => {
  const answer = await fetch('api/recordings' + path, options);
  if (answer.ok) return;
  const said = await answer.json().catch(() => null);
  throw new Error(typeof said?.detail === 'string' ? said.detail : `The server refused it (${answer.status}).`);
};
const copy = async (file) => {
  show('<span></span><progress max="100"></progress><button class="hs-button">Cancel</button>', true);
  const bar = box.querySelector('progress');
  const key = Math.random().toString(36).slice(2, 12);
  let going = true;
  box.querySelector('span').textContent = `Copying ${file.name} …`;
  box.querySelector('button').onclick = () => { going = false; };
  for (let at = 0; at < file.size; at += PIECE) {
    if (!going) {
      await ask('/' + encodeURIComponent(file.name), {method: 'DELETE'});
      throw new Error(`${file.name} was not copied.`);
    }
    const piece = file.slice(at, at + PIECE);
    await ask(`/${encodeURIComponent(file.name)}?offset=${at}&size=${file.size}&copy=${key}`,
      {method: 'PUT', body: await piece.arrayBuffer(), headers: {'Content-Type': 'application/octet-stream'}});
    bar.value = 100 * (at + piece.size) / file.size;
  }
};
window.addEventListener('dragover', (event) => {
  if (!carries(event)) return;
  event.preventDefault();
  if (!busy) show('<b>Drop a recording</b> to copy it to the others and open it.', false);
});
window.addEventListener('dragleave', (event) => { if (!busy && !event.relatedTarget) hide(); });
window.addEventListener('drop', async (event) => {
  if (!carries(event)) return;
  event.preventDefault();
  if (busy) return;
  const files = [...event.dataTransfer.files].sort((a, b) => RECORDING.test(a.name) - RECORDING.test(b.name));
  const last = files.at(-1);
  busy = true;
  try {
    if (!last?.size) throw new Error('This is empty or a folder; copy folders to where hemislam was started, and open them from there.');
    for (const file of files) await copy(file); // files that belong to a recording come before it
    if (RECORDING.test(last.name))
      await ask('', {method: 'POST', body: JSON.stringify({path: last.name}), headers: {'Content-Type': 'application/json'}});
    hide();
  } catch (error) {
    end(error.message);
  }
  busy = false;
});
