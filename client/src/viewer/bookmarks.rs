//! Views that somebody wants to come back to.

use super::{Ask, View, Viewer};
use egui::{RichText, TextEdit, Ui};
use serde::{Deserialize, Serialize};

/// A view with a name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Bookmark {
    /// What it is called.
    pub name: String,
    /// Where it is: what follows the `#` of an address.
    pub view: String,
}

/// Those of a scene.
#[derive(Debug, Default)]
pub(super) struct Bookmarks {
    pub(super) list: Vec<Bookmark>,
    /// What is being written.
    name: String,
}

/// The longest name, in letters.
const NAME_MAX: usize = 60;

/// Bookmarks of a text that [`Ask::Keep`] asked to be kept; those that lead nowhere are left out.
#[must_use]
pub fn read(text: &str) -> Vec<Bookmark> {
    let all: Vec<Bookmark> = serde_json::from_str(text).unwrap_or_default();
    all.into_iter().filter(|one| View::parse(&one.view, [1, 1]).is_some()).collect()
}

/// The list in the panel.
pub(super) fn show(viewer: &mut Viewer, ui: &mut Ui) {
    ui.horizontal(|ui| {
        let hint = TextEdit::singleline(&mut viewer.bookmarks.name).hint_text("name of this view");
        let entered = ui.add(hint.char_limit(NAME_MAX).desired_width(150.0)).lost_focus()
            && ui.input(|input| input.key_pressed(egui::Key::Enter));
        if ui.button("Keep").clicked() || entered {
            viewer.keep();
        }
    });
    let (mut wanted, mut gone) = (None, None);
    for (i, one) in viewer.bookmarks.list.iter().enumerate() {
        ui.horizontal(|ui| {
            if ui.link(&one.name).on_hover_text(&one.view).clicked() {
                wanted = Some(one.view.clone());
            }
            if ui.small_button(RichText::new("×").weak()).on_hover_text("forget it").clicked() {
                gone = Some(i);
            }
        });
    }
    if let Some(view) = wanted {
        viewer.go_to(&view);
    }
    if let Some(i) = gone {
        viewer.bookmarks.list.remove(i);
        viewer.ask_to_keep();
    }
}

impl Viewer {
    /// Has it know bookmarks that were kept.
    pub fn recall(&mut self, bookmarks: Vec<Bookmark>) {
        self.bookmarks.list = bookmarks;
    }

    /// The bookmarks.
    #[must_use]
    pub fn bookmarks(&self) -> &[Bookmark] {
        &self.bookmarks.list
    }

    /// Keeps the view as it is, by the name that was written, or a number.
    pub(super) fn keep(&mut self) {
        let written = std::mem::take(&mut self.bookmarks.name);
        let name = match written.trim() {
            "" => format!("view {}", self.bookmarks.list.len() + 1),
            name => name.to_owned(),
        };
        let one = Bookmark { name, view: self.view() };
        match self.bookmarks.list.iter_mut().find(|known| known.name == one.name) {
            Some(known) => *known = one,
            None => self.bookmarks.list.push(one),
        }
        self.ask_to_keep();
    }

    fn ask_to_keep(&mut self) {
        if let Ok(text) = serde_json::to_string_pretty(&self.bookmarks.list) {
            self.asks.push(Ask::Keep(text));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_leads_nowhere_is_left_out() {
        let good = Bookmark { name: "summit".into(), view: "1.00,2.00,3.00,0.000,-20.000".into() };
        let text =
            serde_json::to_string(&[&good, &Bookmark { name: "x".into(), view: "here".into() }]).unwrap();
        assert_eq!(read(&text), [good]);
        assert!(read("").is_empty() && read("{}").is_empty());
    }
}
