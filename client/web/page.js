// Starts the viewer, or says why it cannot be started.
import start, { state } from './diamantina.js';

const message = document.getElementById('message');

function fail(why) {
    message.textContent = why;
    message.className = 'failed';
    message.hidden = false;
}

// What is on a lost canvas of WebGL2 does not come back.
document.getElementById('terrain').addEventListener('webglcontextlost', () => {
    fail('The graphics device was lost. Load the page again.');
});

if (typeof WebAssembly !== 'object') {
    fail('The viewer needs WebAssembly, which this browser has not, or has switched off.');
} else {
    start().then(() => {
        // For scripts: window.diamantina.state() tells what the viewer shows.
        window.diamantina = { state: () => JSON.parse(state()) };
    }).catch((error) => {
        console.error(error);
        fail(`The viewer cannot be loaded (${error}). Load the page again.`);
    });
}
