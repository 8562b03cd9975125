// Copies the text beside it, where the browser allows that, and says so.
const said = this.parentElement.querySelector('b'), text = this.parentElement.querySelector('pre').textContent;
if (navigator.clipboard) navigator.clipboard.writeText(text).then(() => { said.textContent = 'Copied.'; }, () => {});
