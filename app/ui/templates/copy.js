// Copies the neighbouring text if the browser allows it, and confirms this.
const said = this.parentElement.querySelector('b'), text = this.parentElement.querySelector('pre').textContent;
if (navigator.clipboard) navigator.clipboard.writeText(text).then(() => { said.textContent = 'Copied.'; }, () => {});
