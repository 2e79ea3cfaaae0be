//! The page around the canvas: its address, what it says, and what only a browser can do.

use js_sys::Promise;
use std::cell::RefCell;
use std::rc::Rc;
use wasm_bindgen::JsCast;
use wasm_bindgen::closure::Closure;
use wasm_bindgen_futures::{JsFuture, spawn_local};
use web_sys::{
    Blob, Document, Element, Event, HtmlAnchorElement, HtmlCanvasElement, HtmlElement, HtmlInputElement, Url,
    Window,
};

/// The canvas's name in the page.
const CANVAS: &str = "terrain";

/// The name of the element that says what there is to say.
const MESSAGE: &str = "message";

/// The name under which the browser keeps the token, as long as the page's tab is open.
const TOKEN: &str = "diamantina token";

/// The page around the canvas.
#[derive(Debug, Clone)]
pub(super) struct Page {
    window: Window,
    document: Document,
    canvas: HtmlCanvasElement,
    message: HtmlElement,
    /// Where somebody wants to be who has changed the address.
    changed: Rc<RefCell<Option<String>>>,
}

impl Page {
    /// The page that this runs in, if it is one with a canvas.
    pub(super) fn find() -> Option<Self> {
        let window = web_sys::window()?;
        let document = window.document()?;
        let canvas = document.get_element_by_id(CANVAS)?.dyn_into().ok()?;
        let message = document.get_element_by_id(MESSAGE)?.dyn_into().ok()?;
        let changed: Rc<RefCell<Option<String>>> = Rc::default();
        Some(Self { window, document, canvas, message, changed })
    }

    pub(super) fn canvas(&self) -> HtmlCanvasElement {
        self.canvas.clone()
    }

    /// The canvas's width and height, in pixels of the screen.
    pub(super) fn size(&self) -> [u32; 2] {
        let scale = self.window.device_pixel_ratio();
        let pixels = |points: i32| {
            let pixels = (f64::from(points) * scale).round().clamp(1.0, 65_535.0);
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped just before")]
            let pixels = pixels as u32;
            pixels
        };
        [pixels(self.canvas.client_width()), pixels(self.canvas.client_height())]
    }

    pub(super) fn title(&self, title: &str) {
        self.document.set_title(title);
    }

    /// Takes away what was said: the canvas shows it all now. From here on, changes of the address are listened to.
    pub(super) fn ready(&self) {
        self.message.set_hidden(true);
        // So that keys go there, and the viewer knows, whoever had the focus while it was being loaded.
        let _ = self.canvas.blur();
        let _ = self.canvas.focus();
        let (location, changed) = (self.window.location(), Rc::clone(&self.changed));
        let listen = Closure::<dyn FnMut()>::new(move || {
            *changed.borrow_mut() = location.hash().ok();
        });
        let _ = self.window.add_event_listener_with_callback("hashchange", listen.as_ref().unchecked_ref());
        // As long as the page.
        listen.forget();
    }

    /// What follows the `#`, if somebody has changed it.
    pub(super) fn take_changed_view(&self) -> Option<String> {
        Some(self.changed.borrow_mut().take()?.trim_start_matches('#').to_owned())
    }

    /// Says why there is nothing to see.
    pub(super) fn fail(&self, why: &str) {
        self.message.set_text_content(Some(why));
        self.message.set_class_name("failed");
        self.message.set_hidden(false);
    }

    /// Says why there is nothing to see, and that a token may help, with a field for it.
    pub(super) fn ask_token(&self, why: &str) {
        self.fail(why);
        // A page that cannot have a form says why all the same.
        let _ = self.append_token_form();
    }

    fn append_token_form(&self) -> Result<(), wasm_bindgen::JsValue> {
        let element = |name: &str| self.document.create_element(name);
        let form = element("form")?;
        let label = element("label")?;
        label.set_text_content(Some("Token"));
        let field: HtmlInputElement = element("input")?.dyn_into().map_err(Element::from)?;
        field.set_type("password");
        field.set_attribute("autocomplete", "off")?;
        field.set_required(true);
        label.append_child(&field)?;
        let button = element("button")?;
        button.set_text_content(Some("Open"));
        form.append_child(&label)?;
        form.append_child(&button)?;
        let window = self.window.clone();
        let submit = Closure::<dyn FnMut(Event)>::new(move |event: Event| {
            event.prevent_default();
            if let Ok(Some(storage)) = window.session_storage() {
                let _ = storage.set_item(TOKEN, field.value().trim());
            }
            let _ = window.location().reload();
        });
        form.add_event_listener_with_callback("submit", submit.as_ref().unchecked_ref())?;
        // As long as the page.
        submit.forget();
        self.message.append_child(&form)?;
        Ok(())
    }

    /// The token that was given on this page, or on one before it in the same tab.
    pub(super) fn token(&self) -> Option<String> {
        self.window.session_storage().ok()??.get_item(TOKEN).ok()?
    }

    /// Offers scenes to choose from.
    pub(super) fn choose(&self, names: &[String]) {
        self.message.set_text_content(Some("Scenes"));
        self.message.set_class_name("scenes");
        let href = self.window.location().pathname().unwrap_or_default();
        for name in names {
            let Some(link) = self.document.create_element("a").ok() else { continue };
            // Names are letters, digits, '-', '_' and '.'.
            let _ = link.set_attribute("href", &format!("{href}?scene={name}"));
            link.set_text_content(Some(name));
            let _ = self.message.append_child(&link);
        }
        self.message.set_hidden(false);
    }

    /// Has the address name the view, without a new entry in the history.
    pub(super) fn follow(&self, view: &str) {
        if let Ok(history) = self.window.history() {
            // Refused where too much has changed; the next time will do.
            let _ =
                history.replace_state_with_url(&wasm_bindgen::JsValue::NULL, "", Some(&format!("#{view}")));
        }
    }

    /// What this browser keeps under a name, if it keeps anything.
    pub(super) fn recall(&self, name: &str) -> Option<String> {
        self.window.local_storage().ok()??.get_item(name).ok()?
    }

    /// Has the browser keep a text under a name; whether it does.
    pub(super) fn keep(&self, name: &str, text: &str) -> bool {
        let storage = self.window.local_storage().ok().flatten();
        storage.is_some_and(|storage| storage.set_item(name, text).is_ok())
    }

    /// Puts a text on the clipboard, if the browser allows it.
    pub(super) fn copy(&self, text: &str) {
        let written: Promise = self.window.navigator().clipboard().write_text(text);
        spawn_local(async {
            // Where it is not allowed, the address is to be read in the message.
            let _ = JsFuture::from(written).await;
        });
    }

    /// Saves what the canvas shows now as a PNG, as a download.
    pub(super) fn save_picture(&self, name: &str) {
        let (document, name) = (self.document.clone(), name.to_owned());
        let save = Closure::once_into_js(move |blob: Option<Blob>| {
            let saved = blob.and_then(|blob| {
                let url = Url::create_object_url_with_blob(&blob).ok()?;
                let link: HtmlAnchorElement = document.create_element("a").ok()?.dyn_into().ok()?;
                link.set_href(&url);
                link.set_download(&name);
                link.click();
                Url::revoke_object_url(&url).ok()
            });
            if saved.is_none() {
                web_sys::console::error_1(&"the picture could not be saved".into());
            }
        });
        let _ = self.canvas.to_blob(save.unchecked_ref());
    }
}

/// What the page's address says.
#[derive(Debug)]
pub(super) struct Address {
    /// The server's, without a slash at its end.
    server: String,
    /// The page's, without query and view.
    page: String,
    query: String,
    /// Where to begin.
    pub(super) view: String,
}

impl Address {
    pub(super) fn of(page: &Page) -> Self {
        let location = page.window.location();
        let [origin, path, query, hash] =
            [location.origin(), location.pathname(), location.search(), location.hash()]
                .map(Result::unwrap_or_default);
        let folder = path.rsplit_once('/').map_or("", |(folder, _)| folder);
        Self {
            server: format!("{origin}{folder}"),
            page: format!("{origin}{path}"),
            query: query.trim_start_matches('?').to_owned(),
            view: hash.trim_start_matches('#').to_owned(),
        }
    }

    /// What the query says of something.
    pub(super) fn asked(&self, what: &str) -> Option<String> {
        let words = self.query.split('&').filter_map(|word| word.split_once('='));
        let found = words.into_iter().find(|(name, value)| *name == what && !value.is_empty())?;
        js_sys::decode_uri_component(found.1).ok().map(String::from)
    }

    /// The address of the scene, or of the server if no scene is named.
    pub(super) fn scene_url(&self) -> String {
        match self.asked("scene") {
            Some(name) => format!("{}/scenes/{name}", self.server),
            None => format!("{}/", self.server),
        }
    }

    /// The page's address for a scene, to be given to others.
    pub(super) fn link(&self, scene: &str) -> String {
        let others = self.query.split('&').filter(|word| !word.is_empty() && !word.starts_with("scene="));
        let words: Vec<String> =
            [format!("scene={scene}")].into_iter().chain(others.map(str::to_owned)).collect();
        format!("{}?{}", self.page, words.join("&"))
    }
}
