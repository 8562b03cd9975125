// Runs once in each page. What it relies on in viser's page is listed in app/ui/viser_adapter.py.
if (!window.hemislamSay) {
  // A click (or Enter) on an element with data-hs: write its word into the hidden field, whose changes viser sends.
  // The number behind the word makes every click a change.
  let said = 0;
  const set = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set;
  window.hemislamSay = (event) => {
    const element = event.target.closest && event.target.closest('[data-hs]');
    if (!element || (event.type === 'keydown' && event.key !== 'Enter')) return;
    const name = element.closest('[data-hs-to]').dataset.hsTo;
    const bridge = document.querySelector(`.hs-bridge[data-name="${name}"]`);
    const input = bridge.parentElement.previousElementSibling.querySelector('input');
    set.call(input, element.dataset.hs + ' #' + (++said) + Math.random().toString(36).slice(2, 6));
    input.dispatchEvent(new Event('input', {bubbles: true}));
  };

  // Keys. On its way up an event passes widgets (the page's root), the body, viser's hotkeys (the html element) and
  // viser's camera (the document). Left and right move a focused slider or tab, else step a frame, never the camera.
  const sideways = (event) => event.key === 'ArrowLeft' || event.key === 'ArrowRight';
  document.body.addEventListener('keydown', (event) => {
    if (sideways(event) && event.target.closest('[role=slider],[role=tab]')) event.stopPropagation();
  });
  document.documentElement.addEventListener('keydown', (event) => {
    if (sideways(event)) event.stopPropagation();
  });
  // Space plays and pauses. Firefox would also click the focused button again when the key comes up.
  document.documentElement.addEventListener('keyup', (event) => {
    if (event.key === ' ' && event.target.closest('button')) event.preventDefault();
  });
}
