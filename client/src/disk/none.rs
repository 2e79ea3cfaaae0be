//! In a browser there is no disk to keep things on: its own HTTP cache does that, since whatever is below a version never
//! changes.

use bytes::Bytes;

/// There is none.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Disk {}

impl Disk {
    pub(crate) fn shelf(&self, _: &str, _: Option<&str>) -> Shelf {
        match *self {}
    }
}

/// Of none.
#[derive(Debug, Clone)]
pub(crate) enum Shelf {}

impl Shelf {
    #[allow(clippy::unused_async, reason = "as where there is one")]
    pub(crate) async fn get(&self, _: Vec<String>) -> Vec<Option<Bytes>> {
        match *self {}
    }

    pub(crate) fn put(&self, _: String, _: u32, _: Bytes) {
        match *self {}
    }

    pub(crate) fn forget(&self, _: String) {
        match *self {}
    }

    pub(crate) fn set_current(&self, _: &str, _: &str) {
        match *self {}
    }
}
