// The viewer in a headless Chromium, as a person uses it, on WebGPU and on WebGL2. Whatever is drawn is judged by its
// pixels: a page whose device is lost at the first frame goes on counting frames.
//
// node check.mjs PLAYWRIGHT CHROMIUM URL CLIENT FOLDER TOKEN SIZE: the folder of playwright-core, the browser, the server of scenes
// `hills`, `lake` (hills and water), `photo` (hills and imagery) and `plain`, which is private, the client's program, a folder for
// pictures, the token of `plain`, and the page's size, as 900x600.
import { execFileSync } from 'node:child_process';
import { readFileSync, writeFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { join } from 'node:path';

const [playwright, executablePath, url, client, folder, token, size] = process.argv.slice(2);
const { chromium } = createRequire(join(playwright, 'package.json'))('playwright-core');

const [width, height] = size.split('x').map(Number);
const SIZE = { width, height };
// On the ground, not far from the middle.
const GROUND = [Math.round(width / 2), Math.round(2 * height / 3)];
// Small pages are for those who want to know soon. In software each page takes seconds to show anything, so
// fewer are opened then.
const QUICK = width < 900;
const ERROR_PIXELS = QUICK ? 4 : 2;
// From the south-west, down into the hills.
const VIEW = { eye: [2500, 500, 2600], heading: 25, pitch: 32 };
const PATIENCE = 120_000;

const COMMON = ['--no-sandbox', '--disable-quic', '--no-first-run', '--disable-background-networking',
    '--disable-component-update', '--disable-sync', '--use-angle=swiftshader'];
// With fewer of these, WebGPU draws nothing and says nothing.
const FLAGS = {
    webgpu: ['--enable-unsafe-webgpu', '--enable-features=Vulkan', '--use-vulkan=swiftshader'],
    webgl: ['--enable-unsafe-swiftshader', '--disable-features=WebGPU'],
};

function check(is_so, what) {
    if (!is_so) throw new Error(what);
}

const hash = ({ eye, heading, pitch }) => `#${[...eye, heading, pitch].join(',')}`;

/// The same view by the client without a window.
function headless(scene, view, path) {
    const [heading, pitch] = [view.heading, view.pitch].map((degrees) => degrees * Math.PI / 180);
    const ahead = [Math.sin(heading) * Math.cos(pitch), Math.cos(heading) * Math.cos(pitch), -Math.sin(pitch)];
    const target = view.eye.map((at, i) => at + 1000 * ahead[i]);
    execFileSync(client, ['render', `${url}/scenes/${scene}`, '-o', path, '--size', `${SIZE.width}x${SIZE.height}`,
        '--error-pixels', `${ERROR_PIXELS}`, '--eye', view.eye.join(','), '--target', target.join(',')]);
    return readFileSync(path);
}

/// How far two pictures differ: the mean of all channels, and the share of pixels that differ by more than 32.
async function compare(page, pictures) {
    return page.evaluate(async (urls) => {
        const [a, b] = await Promise.all(urls.map(async (url) => {
            const image = new Image();
            image.src = url;
            await image.decode();
            const canvas = new OffscreenCanvas(image.width, image.height);
            const context = canvas.getContext('2d');
            context.drawImage(image, 0, 0);
            return context.getImageData(0, 0, image.width, image.height);
        }));
        if (a.width !== b.width || a.height !== b.height) return { mean: 255, off: 1, ground: 0 };
        let [sum, off, ground] = [0, 0, 0];
        for (let i = 0; i < a.data.length; i += 4) {
            const by = [0, 1, 2].map((c) => Math.abs(a.data[i + c] - b.data[i + c]));
            sum += by[0] + by[1] + by[2];
            off += Math.max(...by) > 32;
            ground += Math.max(a.data[i], a.data[i + 1]) > a.data[i + 2] + 8;
        }
        const pixels = a.data.length / 4;
        return { mean: sum / pixels / 3, off: off / pixels, ground: ground / pixels };
    }, pictures.map((bytes) => `data:image/png;base64,${bytes.toString('base64')}`));
}

const state = (page) => page.evaluate(() => window.diamantina?.state());

/// Waits until all that is asked for is drawn and stands still.
async function settled(page, pixels = ERROR_PIXELS) {
    const until = Date.now() + PATIENCE;
    for (;;) {
        const now = await state(page).catch(() => null);
        if (now?.complete && now.moving === 0 && now.error_pixels <= pixels) return now;
        const said = await page.locator('#message').textContent();
        check(Date.now() < until, `not settled: ${JSON.stringify(now)}; the page says: ${said}`);
        await page.waitForTimeout(100);
    }
}

/// A frame and more.
async function frames(page, count) {
    const { frames } = await state(page);
    while ((await state(page)).frames < frames + count) await page.waitForTimeout(20);
}

async function heights(page, reference, blank, graphics) {
    const query = `error=${ERROR_PIXELS}${graphics === 'webgl' ? '&graphics=webgl' : ''}`;
    await page.goto(`${url}/?scene=hills&${query}${hash(VIEW)}`);
    const first = await settled(page);
    check(first.graphics === graphics, `drawn by ${first.graphics}, not ${graphics}`);
    check(first.scene === 'hills', `the scene is ${first.scene}`);
    await page.screenshot({ path: join(folder, `${graphics}-panel.png`) });

    // Without the panel there is nothing but terrain and sky.
    await page.keyboard.press('Tab');
    await frames(page, 3);
    const shot = await page.screenshot({ path: join(folder, `${graphics}.png`) });
    const { mean, off, ground } = await compare(blank, [shot, reference]);
    check(ground > 0.2, `ground on ${(100 * ground).toFixed(1)} % of the picture`);
    check(mean < 2 && off < 0.01, `differs from the client's picture: ${mean.toFixed(2)} on average, ` +
        `${(100 * off).toFixed(2)} % of the pixels by more than 32`);

    // A click tells the height that the server tells.
    await page.mouse.click(...GROUND);
    await frames(page, 3);
    const { marks } = await state(page);
    check(marks.length === 1, `${marks.length} places clicked`);
    const [[x, y, z], error] = marks[0];
    const answer = await fetch(`${url}/scenes/hills/terrain/height?x=${x}&y=${y}`);
    const told = await answer.json();
    // The triangles drawn may be off by their declared error, and so may the server's.
    check(error !== null && error < 20, `declared to be off by ${error} m`);
    const most = error + told.error + 0.01;
    check(Math.abs(told.height - z) <= most, `clicked ${z} at ${x}, ${y}; the server says ${JSON.stringify(told)}`);

    // The wheel goes nearer, and the address follows.
    await page.mouse.move(...GROUND);
    for (let i = 0; i < 4; i++) await page.mouse.wheel(0, -120);
    const nearer = await settled(page);
    await page.waitForFunction(() => location.hash === `#${window.diamantina.state().view}`);
    check(nearer.view !== first.view, 'the wheel does not move the eye');
    const link = page.url();
    check(link.includes('scene=hills') && link.includes(query), `the address is ${link}`);
    const before = await page.screenshot();
    check((await compare(blank, [before, shot])).off > 0.05, 'nothing moved on the picture');

    // The address opens the same view again.
    if (!QUICK || graphics === 'webgpu') {
        await page.goto('about:blank');
        await page.goto(link);
        await settled(page);
        await page.keyboard.press('Tab');
        await frames(page, 3);
        const again = await compare(blank, [before, await page.screenshot()]);
        // What was clicked is marked in the one and not in the other.
        check(again.mean < 2 && again.off < 0.01, `the address opens another view: ${JSON.stringify(again)}`);
    }

    // Who changes the address is flown there.
    await page.evaluate((there) => { location.hash = there; }, hash(VIEW));
    await page.waitForFunction(() => window.diamantina.state().view.startsWith('2500.00,500.00,2600.00,25.000,32.000'));

    // The panel's first slider: more error, fewer triangles.
    const { triangles } = await state(page);
    await page.keyboard.press('Tab');
    await frames(page, 3);
    await page.mouse.move(SIZE.width - 165, 152);
    await page.mouse.down();
    // A button that goes down and up between two frames moves nothing.
    await frames(page, 2);
    await page.mouse.up();
    await page.waitForFunction(
        (before) => window.diamantina.state().asked_error_pixels > 20 && window.diamantina.state().triangles < before,
        triangles);

    const last = await state(page);
    return `${mean.toFixed(2)} from the client's picture, longest frame ${last.longest_frame_milliseconds.toFixed(0)} ms`;
}

/// A context that waits for pages, too, as long as for all else.
async function patient(browser, options) {
    const context = await browser.newContext(options);
    context.setDefaultTimeout(PATIENCE);
    return context;
}

/// Opens the page on what `query` asks for, and takes a picture without the panel once nothing changes any more.
async function picture(page, graphics, query, name) {
    const more = `&error=${ERROR_PIXELS}${graphics === 'webgl' ? '&graphics=webgl' : ''}`;
    await page.goto('about:blank');
    await page.goto(`${url}/?${query}${more}${hash(VIEW)}`);
    await settled(page);
    await page.keyboard.press('Tab');
    await frames(page, 3);
    return page.screenshot({ path: join(folder, `${graphics}-${name}.png`) });
}

/// Water: as the client draws it but for its waves, which move, and not where it is left out.
async function water(page, blank, graphics) {
    const shot = (more, name) => picture(page, graphics, `scene=lake${more}`, name);
    const wet = await shot('', 'lake');
    const beside = await compare(blank, [wet, lake]);
    check(beside.mean < 6 && beside.off < 0.1, `water differs from the client's: ${JSON.stringify(beside)}`);
    // A busy machine may show the picture of a frame before.
    let moves = false;
    for (let i = 0; i < 5 && !moves; i++) {
        await frames(page, 10);
        moves = (await compare(blank, [wet, await page.screenshot()])).mean > 0;
    }
    check(moves, 'the waves stand still');
    if (!QUICK) {
        const without = await compare(blank, [wet, await shot('&layer=terrain', 'dry')]);
        check(without.off > 0.05, `water is hardly seen: ${JSON.stringify(without)}`);
    }
    return `water ${beside.mean.toFixed(2)}`;
}

/// Imagery: as the client draws it, and not where it is left out.
async function imagery(page, blank, graphics) {
    const shot = (more, name) => picture(page, graphics, `scene=photo${more}`, name);
    const draped = await shot('', 'photo');
    const beside = await compare(blank, [draped, photo]);
    check(beside.mean < 2 && beside.off < 0.01, `imagery differs from the client's: ${JSON.stringify(beside)}`);
    if (!QUICK) {
        const without = await compare(blank, [draped, await shot('&texture=none', 'bare')]);
        check(without.off > 0.1, `imagery is hardly seen: ${JSON.stringify(without)}`);
    }
    return `imagery ${beside.mean.toFixed(2)}`;
}

/// Fingers on a screen that has no mouse: what one takes hold of stays under it, two apart go nearer, a tap asks for the height.
async function touch(browser, graphics) {
    const context = await patient(browser, { viewport: SIZE, deviceScaleFactor: 1, hasTouch: true });
    const page = await context.newPage();
    const devices = await context.newCDPSession(page);
    const finger = async (type, ...points) => {
        const touchPoints = points.map(([x, y], id) => ({ x, y, id, radiusX: 5, radiusY: 5, force: 1 }));
        await devices.send('Input.dispatchTouchEvent', { type, touchPoints });
        // The browser merges what moves between two frames.
        if (type === 'touchMove') await frames(page, 2);
    };
    let known = [null, null];
    const tap = async (point) => {
        await finger('touchStart', point);
        await finger('touchEnd');
        // Two at most are kept.
        const place = await page.waitForFunction(([u, v]) => {
            const { marks } = window.diamantina.state();
            const last = marks.at(-1)?.[0];
            return last && (last[0] !== u || last[1] !== v) && last;
        }, known);
        known = await place.jsonValue();
        return known;
    };
    const pixels = 4 * ERROR_PIXELS;
    const away = ([x, y, z], [u, v, w]) => Math.hypot(x - u, y - v, z - w);
    /// Where the eye comes to rest: what fingers began goes on for a while.
    const eye = async () => {
        for (let before; ;) {
            const { view } = await settled(page, pixels);
            if (view === before) return view.split(',').slice(0, 3).map(Number);
            before = view;
            await frames(page, 5);
        }
    };
    const steps = [1, 2, 3, 4, 5, 6];

    await page.goto(`${url}/?scene=hills&error=${pixels}${graphics === 'webgl' ? '&graphics=webgl' : ''}${hash(VIEW)}`);
    await settled(page, pixels);
    await page.keyboard.press('Tab');
    await frames(page, 3);
    const [x, y] = GROUND;
    const held = await tap([x, y]);
    const begin = await eye();
    const far = away(begin, held);
    await finger('touchStart', [x, y]);
    for (const i of steps) await finger('touchMove', [x - 8 * i, y + 4 * i]);
    await finger('touchEnd');
    check(away(begin, await eye()) > 0.01 * far, 'a finger does not move the eye');
    const [u, v] = [x - 8 * steps.length, y + 4 * steps.length];
    const still = await tap([u, v]);
    check(away(still, held) < 0.03 * far, `the finger lost the ground by ${away(still, held)} m of ${far}`);

    const before = away(await eye(), held);
    await finger('touchStart', [u - 20, v]);
    await finger('touchStart', [u - 20, v], [u + 20, v]);
    for (const i of steps) await finger('touchMove', [u - 20 - 5 * i, v], [u + 20 + 5 * i, v]);
    await finger('touchEnd');
    const after = away(await eye(), held);
    // The fingers are two and a half times as far apart; what they did first only tells what they are about.
    check(after < 0.7 * before, `two fingers go from ${before} m to ${after} m`);
    await page.screenshot({ path: join(folder, `${graphics}-touch.png`) });
    await context.close();
    return `touch ${(before / after).toFixed(2)}`;
}

/// A page that says what to choose from, if it is not told.
async function choice(page) {
    // A page that draws all along keeps the next one of its process waiting, on a busy machine for a minute and more.
    await page.goto('about:blank');
    await page.goto(`${url}/`);
    const links = page.locator('#message a');
    await links.first().waitFor();
    const names = await links.allTextContents();
    check(names.toSorted().join() === 'hills,lake,photo', `to choose from: ${names}`);
    await links.first().click();
    await page.waitForFunction(() => window.diamantina?.state().frames > 0);
    check((await state(page)).scene === 'hills', 'another scene was chosen');
    await page.goto(`${url}/?scene=nowhere`);
    await page.locator('#message.failed').waitFor();
}

/// A private scene, which is not there without its token.
async function secret(page) {
    await page.goto(`${url}/?scene=plain`);
    for (const given of ['wrong', token]) {
        await page.locator('#message input').fill(given);
        await page.locator('#message').screenshot({ path: join(folder, 'token.png') });
        await Promise.all([page.waitForEvent('load'), page.locator('#message button').click()]);
    }
    await page.waitForFunction(() => window.diamantina?.state().scene === 'plain');
    check(!page.url().includes(token), 'the token is in the address');
}

const reference = headless('hills', VIEW, join(folder, 'client.png'));
const lake = headless('lake', VIEW, join(folder, 'client-lake.png'));
const photo = headless('photo', VIEW, join(folder, 'client-photo.png'));
for (const graphics of ['webgpu', 'webgl']) {
    const began = Date.now();
    const args = [...COMMON, ...FLAGS[graphics]];
    const browser = await chromium.launch({ executablePath, headless: true, args });
    try {
        const context = await patient(browser, { viewport: SIZE, deviceScaleFactor: 1 });
        const [page, blank] = [await context.newPage(), await context.newPage()];
        const wrong = [];
        let allowed = null;
        page.on('console', (line) => line.type() === 'error' && !allowed?.test(line.text()) && wrong.push(line.text()));
        page.on('pageerror', (error) => wrong.push(`${error}`));
        page.on('response', (answer) => answer.status() >= 400 && !allowed && wrong.push(`${answer.status()} ${answer.url()}`));
        const look = async () => [
            await heights(page, reference, blank, graphics),
            await water(page, blank, graphics),
            await imagery(page, blank, graphics),
            await touch(browser, graphics),
        ].join(', ');
        const what = await look().catch(async (error) => {
            await page.screenshot({ path: join(folder, `${graphics}-failed.png`) }).catch(() => {});
            throw new Error(`${graphics}: ${error.message}; errors: ${wrong.join(' | ') || 'none'}`);
        });
        // Of a scene that is not there the browser says so by itself.
        allowed = /404/;
        if (graphics === 'webgpu') {
            await choice(page);
            await secret(page);
        }
        check(wrong.length === 0, `${graphics}: the console says ${wrong.join(' | ')}`);
        console.log(`${graphics}: ${what}, ${((Date.now() - began) / 1000).toFixed(1)} s`);
    } finally {
        await browser.close();
    }
}
writeFileSync(join(folder, 'done'), '');
