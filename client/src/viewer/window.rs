//! The viewer in a native window.

use super::display::{Display, IDLE};
use super::shelf::Shelf;
use super::{Ask, Viewer};
use crate::render::{self, Offscreen, RenderError};
use crate::{annotate, headless, picture};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;
use winit::application::ApplicationHandler;
use winit::dpi::PhysicalSize;
use winit::event::WindowEvent;
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop};
use winit::window::{Window, WindowId};

/// Why there is no window.
#[derive(Debug, thiserror::Error)]
pub enum WindowError {
    /// The system has no screen for us.
    #[error("no window: {0}; on a machine without a screen use `diamantina-client render`")]
    System(String),
    /// Nothing can be drawn.
    #[error(transparent)]
    Render(#[from] RenderError),
}

/// Shows a viewer in a window until it is closed.
///
/// # Errors
/// When there is no screen, or no graphics adapter that draws on it.
pub fn run(mut viewer: Viewer, title: &str, options: &render::Options) -> Result<(), WindowError> {
    let system = |e: &dyn std::fmt::Display| WindowError::System(e.to_string());
    let events = EventLoop::new().map_err(|e| system(&e))?;
    let shelf = Shelf::of(viewer.url());
    match shelf.recall() {
        Ok(bookmarks) => viewer.recall(bookmarks),
        Err(error) => viewer.tell(error.to_string()),
    }
    let mut shown = Shown {
        shelf,
        viewer,
        title: title.to_owned(),
        options: *options,
        display: None,
        failed: None,
        due: Instant::now(),
    };
    events.run_app(&mut shown).map_err(|e| system(&e))?;
    shown.failed.map_or(Ok(()), Err)
}

struct Shown {
    shelf: Shelf,
    viewer: Viewer,
    title: String,
    options: render::Options,
    display: Option<Display>,
    failed: Option<WindowError>,
    /// When the next frame is drawn at the latest.
    due: Instant,
}

impl Shown {
    fn open(&self, events: &ActiveEventLoop) -> Result<Display, WindowError> {
        let size = PhysicalSize::<u32>::from(self.viewer.camera().size);
        let attributes = Window::default_attributes().with_title(&self.title).with_inner_size(size);
        let window = events.create_window(attributes).map_err(|e| WindowError::System(e.to_string()))?;
        let display = Display::new(Arc::new(window), &self.options, render::BACKENDS);
        Ok(pollster::block_on(display)?)
    }

    fn fulfil(&mut self, events: &ActiveEventLoop) {
        for ask in self.viewer.take_asks() {
            match ask {
                Ask::Quit => events.exit(),
                Ask::Copy(text) => {
                    if let Some(display) = &mut self.display {
                        display.set_clipboard_text(&text);
                    }
                    self.viewer.tell(format!("copied {text}"));
                }
                Ask::Keep(text) => {
                    if let Err(error) = self.shelf.keep(&text) {
                        self.viewer.tell(error.to_string());
                    }
                }
                Ask::Screenshot(path) => {
                    let saved = self.photograph(&path);
                    self.viewer.tell(match saved {
                        Ok(()) => format!("saved {}", path.display()),
                        Err(error) => error.to_string(),
                    });
                }
            }
        }
    }

    /// Saves a picture of the terrain as it is drawn now, with its annotations, without the panel.
    fn photograph(&mut self, path: &Path) -> Result<(), headless::HeadlessError> {
        let samples = if self.viewer.is_true() { 1 } else { self.options.samples };
        let mut offscreen = Offscreen::new(&render::Options { samples, ..self.options })?;
        let layers = &self.viewer.terrain().scene().layers;
        offscreen.drape(self.viewer.drape());
        offscreen.mirror(self.viewer.mirrors());
        offscreen.draw(layers, self.viewer.camera(), &self.viewer.items(), self.viewer.look())?;
        let size = self.viewer.camera().size;
        if self.viewer.look().annotations.is_any() {
            offscreen.draw_over(annotate::pixels_per_point(size), |painter, area| {
                self.viewer.annotate(painter, area);
            });
        }
        let picture: picture::Picture = offscreen.read()?;
        headless::save(&picture, path)
    }
}

impl ApplicationHandler for Shown {
    fn resumed(&mut self, events: &ActiveEventLoop) {
        if self.display.is_some() {
            return;
        }
        match self.open(events) {
            Ok(display) => {
                display.request_redraw();
                self.display = Some(display);
            }
            Err(error) => {
                self.failed = Some(error);
                events.exit();
            }
        }
    }

    fn window_event(&mut self, events: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        let Some(display) = &mut self.display else { return };
        match event {
            WindowEvent::CloseRequested => events.exit(),
            WindowEvent::RedrawRequested => {
                let wait = display.draw(&mut self.viewer, true);
                self.due = Instant::now() + wait;
                self.fulfil(events);
            }
            event => display.take(&event),
        }
    }

    fn about_to_wait(&mut self, events: &ActiveEventLoop) {
        if Instant::now() >= self.due
            && let Some(display) = &self.display
        {
            display.request_redraw();
            self.due = Instant::now() + IDLE;
        }
        events.set_control_flow(ControlFlow::WaitUntil(self.due));
    }
}
