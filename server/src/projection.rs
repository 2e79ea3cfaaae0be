//! Map projections by EPSG code: the definitions are crs-definitions's.

pub use diamantina_protocol::projection::{
    Projection, ProjectionError, ellipsoid, unit_metres, vertical_metres,
};

/// The PROJ string of an EPSG code, for instance 32611; `None` if the code is not in the tables.
#[must_use]
pub fn epsg(code: u32) -> Option<&'static str> {
    Some(crs_definitions::from_code(u16::try_from(code).ok()?)?.proj4)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_found_or_not() {
        assert!(Projection::new(epsg(32611).unwrap()).is_ok());
        assert_eq!(epsg(99_999), None);
        assert_eq!(epsg(1), None);
    }
}
