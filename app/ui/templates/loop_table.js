// The whole table is replaced at every change: keep the scroll position, but show a row that was just chosen.
const box = this.parentNode, row = box.querySelector('[aria-selected=true]');
box.scrollTop = window.hemislamTableScroll || 0;
if (row && row.dataset.hs !== window.hemislamRow) {
  const low = row.offsetTop - 26, high = row.offsetTop + row.offsetHeight - box.clientHeight;
  if (box.scrollTop > low) box.scrollTop = low; else if (box.scrollTop < high) box.scrollTop = high;
}
window.hemislamRow = row ? row.dataset.hs : '';
