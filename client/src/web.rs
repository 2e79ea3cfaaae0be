//! The viewer on a page, in a canvas.
//!
//! The page is that of a server: its address, `?scene=NAME`, says what to open; `#x,y,z,heading,pitch` (and `,seconds` of water that
//! changes with time) where to begin, and follows the view, so that it can be kept, sent and opened again, in a native window too. Further words of the
//! query: `error=PIXELS`, `encoding=points|tin`, `zone=NAME`, `layer=NAME,NAME` (those alone), `graphics=webgl` (where WebGPU is there, but does not work).
//!
//! What the page shows besides the canvas, it shows by its own means: see `web/` beside this crate.

mod page;

use crate::encoding::Encoding;
use crate::fetch::{self, FetchError};
use crate::render::{self, Look};
use crate::terrain::{self, Imagery, Terrain, TerrainError};
use crate::texture::FADE_SECONDS;
use crate::viewer::display::{Display, IDLE};
use crate::viewer::{self, Ask, Viewer};
use page::{Address, Page};
use serde::Serialize;
use std::cell::RefCell;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;
use wasm_bindgen::prelude::wasm_bindgen;
use wasm_bindgen_futures::spawn_local;
use web_time::Instant;
use winit::application::ApplicationHandler;
use winit::event::WindowEvent;
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop};
use winit::platform::web::{EventLoopExtWebSys as _, WindowAttributesExtWebSys as _};
use winit::window::{Window, WindowId};

/// How often the address follows the view at most: browsers refuse more than a hundred changes in half a minute.
const FOLLOW: Duration = Duration::from_millis(500);

/// Memory for surfaces. A module of 32 bits cannot have more than 4 GiB, and a telephone has less.
const MEMORY_BYTES: usize = 384 << 20;

/// GPU memory for surfaces.
const GPU_BYTES: u64 = 256 << 20;

/// Seconds that points move.
const MORPH_SECONDS: f64 = 0.3;

/// The error to reach, in pixels, unless the address says otherwise.
const TOLERANCE_PIXELS: f64 = 1.0;

/// What a page's scripts are told of the viewer.
#[derive(Debug, Clone, Default, Serialize)]
struct State {
    scene: String,
    version: String,
    /// Where the eye is, as in the address.
    view: String,
    graphics: &'static str,
    frames: u64,
    complete: bool,
    moving: usize,
    asked_error_pixels: f64,
    /// `null` while a root is missing.
    error_pixels: f64,
    triangles: u64,
    bytes: u64,
    requests: u64,
    /// The longest frame so far, in milliseconds, without what the graphics do by themselves.
    longest_frame_milliseconds: f64,
    /// What was clicked: x, y and height in metres, and how far the height may be off.
    marks: Vec<([f64; 3], Option<f64>)>,
    /// The time of water that changes with it, in seconds, and whether it runs and waits for data.
    time: f64,
    plays: bool,
    waits: bool,
    problem: Option<String>,
}

thread_local! {
    static STATE: RefCell<State> = RefCell::default();
}

/// What the viewer shows, as JSON.
#[must_use]
#[wasm_bindgen]
pub fn state() -> String {
    STATE.with_borrow(|state| serde_json::to_string(state).unwrap_or_default())
}

/// Shows the scene that the page's address names.
pub fn start() {
    std::panic::set_hook(Box::new(|panic| {
        web_sys::console::error_1(&panic.to_string().into());
        if let Some(page) = Page::find() {
            page.fail("The viewer has failed; the browser's console says where. Load the page again.");
        }
    }));
    let Some(page) = Page::find() else { return };
    spawn_local(async move {
        if let Err(error) = open(&page).await {
            page.fail(&error);
        }
    });
}

/// The options of the page's address, with the token that the page was given.
fn options(address: &Address, token: Option<String>) -> Result<terrain::Options, String> {
    let encoding = match address.asked("encoding") {
        None => Encoding::default(),
        Some(name) => Encoding::of(&name)
            .ok_or_else(|| format!("The address asks for encoding={name}: expected points or tin."))?,
    };
    let tolerance_pixels = match address.asked("error") {
        None => TOLERANCE_PIXELS,
        Some(text) => text.parse().ok().filter(|n: &f64| n.is_finite() && *n > 0.0).ok_or_else(|| {
            format!("The address asks for error={text}: expected pixels, a number above 0.")
        })?,
    };
    Ok(terrain::Options {
        tolerance_pixels,
        memory_bytes: MEMORY_BYTES,
        gpu_bytes: GPU_BYTES,
        morph_seconds: MORPH_SECONDS,
        // Half of what a window takes: as much again is on the GPU.
        texture_bytes: 64 << 20,
        fade_seconds: FADE_SECONDS,
        layers: address.asked("layer").map(|names| names.split(',').map(str::to_owned).collect()),
        zone: address.asked("zone"),
        time: viewer::View::parse(&address.view, [1, 1]).and_then(|view| view.seconds).unwrap_or(0.0),
        imagery: Imagery::asked(address.asked("texture")),
        fetch: fetch::Options {
            encoding,
            token: token.map(Into::into),
            follow: Some(viewer::FOLLOW),
            ..fetch::Options::default()
        },
        ..terrain::Options::default()
    })
}

async fn open(page: &Page) -> Result<(), String> {
    let address = Address::of(page);
    let options = options(&address, page.token())?;
    let backends = match address.asked("graphics").as_deref() {
        None | Some("webgpu") => render::BACKENDS,
        Some("webgl") => wgpu::Backends::GL,
        Some(other) => {
            return Err(format!("The address asks for graphics={other}: expected webgpu or webgl."));
        }
    };
    let terrain = match Terrain::connect(&address.scene_url(), options).await {
        Err(TerrainError::Fetch(FetchError::Choose(names))) if !names.is_empty() => {
            page.choose(&names);
            return Ok(());
        }
        // Nobody is told which scenes are private.
        Err(error @ TerrainError::Fetch(FetchError::Status { status: 404, .. })) => {
            page.ask_token(&error.to_string());
            return Ok(());
        }
        terrain => terrain.map_err(|e| e.to_string())?,
    };
    let size = page.size();
    let view = viewer::View::parse(&address.view, size);
    let scene = terrain.scene();
    page.title(&format!("{} - Diamantina", scene.name));
    let look = Look::of(scene);
    let link = address.link(&scene.name);
    let mut viewer = Viewer::new(terrain, &link, look, size, view);
    viewer.recall(viewer::read_bookmarks(&page.recall(&shelf(viewer.url())).unwrap_or_default()));
    let events = EventLoop::new().map_err(|e| e.to_string())?;
    let shown = Shown {
        viewer,
        page: page.clone(),
        backends,
        display: Rc::default(),
        due: Instant::now(),
        followed: (Instant::now(), String::new()),
        pictures: 0,
        wants_picture: false,
        frames: 0,
        longest: Duration::ZERO,
    };
    events.spawn_app(shown);
    Ok(())
}

/// The name under which the browser keeps a scene's bookmarks.
fn shelf(url: &str) -> String {
    format!("diamantina bookmarks {url}")
}

/// The viewer in its canvas.
struct Shown {
    viewer: Viewer,
    page: Page,
    backends: wgpu::Backends,
    /// There once the browser has given a graphics device.
    display: Rc<RefCell<Option<Display>>>,
    /// When the next frame is drawn at the latest.
    due: Instant,
    /// When the address followed the view the last time, and to where.
    followed: (Instant, String),
    /// Pictures saved so far.
    pictures: u32,
    /// Whether the next frame is one for a picture, without the panel.
    wants_picture: bool,
    frames: u64,
    longest: Duration,
}

impl Shown {
    /// Draws a frame and does what comes with it.
    fn frame(&mut self) {
        let display = Rc::clone(&self.display);
        let mut display = display.borrow_mut();
        let Some(display) = display.as_mut() else { return };
        if let Some(view) = self.page.take_changed_view() {
            self.viewer.go_to(&view);
        }
        let began = Instant::now();
        let wait = display.draw(&mut self.viewer, !self.wants_picture);
        self.longest = self.longest.max(began.elapsed());
        self.due = Instant::now() + wait;
        self.frames += 1;
        if std::mem::take(&mut self.wants_picture) {
            self.pictures += 1;
            let name = format!("{}-{:03}.png", self.viewer.terrain().scene().name, self.pictures);
            // Within the frame that drew it: a canvas may forget what it shows as soon as it is shown.
            self.page.save_picture(&name);
            self.viewer.tell(format!("saved {name}"));
            display.request_redraw();
        }
        for ask in self.viewer.take_asks() {
            match ask {
                // A page is closed by the browser.
                Ask::Quit => {}
                Ask::Copy(text) => {
                    self.page.copy(&text);
                    self.viewer.tell(format!("copied {text}"));
                }
                Ask::Keep(text) => {
                    if !self.page.keep(&shelf(self.viewer.url()), &text) {
                        self.viewer.tell("this browser keeps no bookmarks beyond this page");
                    }
                }
                Ask::Screenshot(_) => {
                    self.wants_picture = true;
                    display.request_redraw();
                }
            }
        }
        self.tell(display.graphics());
        self.follow();
    }

    /// Has the page's address name the view.
    fn follow(&mut self) {
        let (at, before) = &self.followed;
        let view = self.viewer.view();
        if at.elapsed() >= FOLLOW && view != *before {
            self.page.follow(&view);
            self.followed = (Instant::now(), view);
        }
    }

    fn tell(&self, graphics: &'static str) {
        let (terrain, frame) = (self.viewer.terrain(), self.viewer.frame());
        STATE.with_borrow_mut(|state| {
            *state = State {
                scene: terrain.scene().name.clone(),
                version: terrain.scene().version.clone(),
                view: self.viewer.view(),
                graphics,
                frames: self.frames,
                complete: frame.complete,
                moving: frame.moving,
                asked_error_pixels: terrain.tolerance_pixels(),
                error_pixels: frame.error_pixels,
                triangles: self.viewer.drawn().triangles,
                bytes: frame.stats.traffic.bytes,
                requests: frame.stats.traffic.requests,
                longest_frame_milliseconds: self.longest.as_secs_f64() * 1e3,
                marks: self.viewer.marks().iter().map(|mark| (mark.place.to_array(), mark.error)).collect(),
                time: self.viewer.player().seconds,
                plays: self.viewer.player().plays,
                waits: self.viewer.player().waits,
                problem: terrain.problem().map(str::to_owned),
            };
        });
    }
}

impl ApplicationHandler for Shown {
    fn resumed(&mut self, events: &ActiveEventLoop) {
        if self.display.borrow().is_some() {
            return;
        }
        let attributes = Window::default_attributes().with_canvas(Some(self.page.canvas()));
        let window = match events.create_window(attributes) {
            Ok(window) => Arc::new(window),
            Err(error) => return self.page.fail(&error.to_string()),
        };
        let (slot, page, backends) = (Rc::clone(&self.display), self.page.clone(), self.backends);
        spawn_local(async move {
            let options = render::Options { budget_bytes: GPU_BYTES, ..render::Options::default() };
            match Display::new(window, &options, backends).await {
                Ok(display) => {
                    display.on_loss(|why| {
                        if let Some(page) = Page::find() {
                            page.fail(&format!("The graphics device was lost ({why}). Load the page again."));
                        }
                    });
                    display.request_redraw();
                    *slot.borrow_mut() = Some(display);
                    page.ready();
                }
                Err(error) => page.fail(&error.to_string()),
            }
        });
    }

    fn window_event(&mut self, _: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        if matches!(event, WindowEvent::RedrawRequested) {
            self.frame();
        } else if let Some(display) = self.display.borrow_mut().as_mut() {
            display.take(&event);
        }
    }

    fn about_to_wait(&mut self, events: &ActiveEventLoop) {
        if Instant::now() >= self.due
            && let Some(display) = self.display.borrow().as_ref()
        {
            display.request_redraw();
            self.due = Instant::now() + IDLE;
        }
        events.set_control_flow(ControlFlow::WaitUntil(self.due));
    }
}
