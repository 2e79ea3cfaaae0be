//! Where a scene's frame lies on the globe: longitudes and latitudes, true north, true lengths.
//!
//! A frame is a plane, and its y axis is north in its middle at best; its metres are those of a map projection, which in
//! Mercator's are half as long at 60 degrees. What is told of pictures counts on the ground.

use diamantina_protocol::message::{Crs, Frame};
use diamantina_protocol::projection::{Projection, ellipsoid};
use glam::{DVec2, DVec3};

/// Half axes of WGS 84, in metres.
const EARTH: [f64; 2] = [6_378_137.0, 6_356_752.314_2];

/// Metres over which lengths are compared: long enough for the digits of projections, short beside their distortions.
const SPAN: f64 = 500.0;

/// Degrees of latitude over which north is looked for.
const STEP_DEGREES: f64 = 1e-3;

/// Where the frame lies on the globe.
#[derive(Debug)]
pub struct Globe {
    projection: Projection,
    /// How the frame lies in its system.
    crs: Crs,
    /// Half axes of the ellipsoid, in metres.
    axes: [f64; 2],
}

impl Globe {
    /// `None` if that is not known.
    #[must_use]
    pub fn of(frame: &Frame) -> Option<Self> {
        let crs = frame.crs.as_ref()?;
        let proj4 = crs.proj4.as_deref()?;
        let projection = Projection::new(proj4).ok()?;
        let (a, b) = ellipsoid(proj4);
        // Longitudes and latitudes of the Earth are those of WGS 84, whatever sphere a map is drawn from.
        let axes = if (a - EARTH[0]).abs() < 20_000.0 { EARTH } else { [a, b] };
        Some(Self { projection, crs: crs.clone(), axes })
    }

    /// Longitude, from -180 to 180, and latitude in degrees of a place in the frame's metres.
    #[must_use]
    pub fn lonlat(&self, place: DVec3) -> Option<[f64; 2]> {
        self.projection.lonlat(&self.crs, [place.x, place.y])
    }

    /// The direction to the north pole at a place: a unit vector of the frame. `None` where there is none, as at the pole.
    #[must_use]
    pub fn north(&self, place: DVec3) -> Option<DVec2> {
        let [lon, lat] = self.lonlat(place)?;
        // Backwards, where a step ahead would lead past the pole.
        let step = if lat + STEP_DEGREES > 90.0 { -STEP_DEGREES } else { STEP_DEGREES };
        let (x, y) = self.projection.forward(lon, lat + step)?;
        let there = [x, y];
        let along = [0, 1].map(|i| (there[i] - self.crs.origin[i]) / self.crs.per_metre[i] - place[i]);
        (DVec2::from(along) * step.signum()).try_normalize()
    }

    /// Metres on the ground (at height 0) for each metre of the frame in a direction, a unit vector.
    #[must_use]
    pub fn ground_metres(&self, place: DVec3, along: DVec2) -> Option<f64> {
        let step = (along * SPAN).extend(0.0);
        let [a, b] = [self.lonlat(place - step)?, self.lonlat(place + step)?];
        let lat = f64::midpoint(a[1], b[1]).to_radians();
        let [major, minor] = self.axes;
        let e2 = 1.0 - (minor / major).powi(2);
        let w2 = 1.0 - e2 * lat.sin().powi(2);
        // Radii of curvature along the meridian and across it.
        let [meridian, across] = [major * (1.0 - e2) / w2.powf(1.5), major / w2.sqrt()];
        let lon_step = (b[0] - a[0] + 180.0).rem_euclid(360.0) - 180.0;
        let ground =
            DVec2::new(lon_step.to_radians() * across * lat.cos(), (b[1] - a[1]).to_radians() * meridian);
        let metres = ground.length() / (2.0 * SPAN);
        // Beyond that a projection says nothing any more.
        (1e-3..=1e3).contains(&metres).then_some(metres)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn globe(proj4: &str, origin: [f64; 2], per_metre: f64) -> Option<Globe> {
        let crs = Crs { name: "made".into(), proj4: Some(proj4.into()), origin, per_metre: [per_metre; 2] };
        Globe::of(&Frame { crs: Some(crs), vertical_unit: "metre".into() })
    }

    #[test]
    fn places_have_longitudes_where_the_frame_has() {
        assert!(Globe::of(&Frame { crs: None, vertical_unit: "metre".into() }).is_none());
        assert!(globe("+proj=nonsense", [0.0; 2], 1.0).is_none());
        // The central meridian of zone 32.
        let globe = globe("+proj=utm +zone=32 +datum=WGS84", [500_000.0, 5_000_000.0], 1.0).unwrap();
        let [lon, lat] = globe.lonlat(DVec3::ZERO).unwrap();
        assert!((lon - 9.0).abs() < 1e-9 && (45.0..45.3).contains(&lat), "{lon} {lat}");
    }

    #[test]
    fn north_is_where_the_pole_is() {
        let utm = globe("+proj=utm +zone=32 +datum=WGS84", [0.0; 2], 1.0).unwrap();
        let north = |x: f64, y: f64| utm.north(DVec3::new(x, y, 0.0)).unwrap();
        assert!((north(500_000.0, 5_000_000.0) - DVec2::Y).length() < 1e-6);
        // Meridians converge: east of the middle one, north lies to the left of the grid's. tan = tan(dlon) sin(lat).
        let place = DVec3::new(700_000.0, 5_000_000.0, 0.0);
        let [lon, lat] = utm.lonlat(place).unwrap();
        let expected = ((lon - 9.0).to_radians().tan() * lat.to_radians().sin()).atan();
        let found = utm.north(place).unwrap();
        assert!((-found.x).atan2(found.y) - expected < 2e-4 && expected > 0.03, "{found} {expected}");
        // Around the south pole it is everywhere else.
        let polar = "+proj=stere +lat_0=-90 +lat_ts=-71 +lon_0=0 +datum=WGS84";
        let polar = globe(polar, [0.0; 2], 1.0).unwrap();
        let found = polar.north(DVec3::new(1e6, 0.0, 0.0)).unwrap();
        assert!((found - DVec2::X).length() < 1e-6, "{found}");
    }

    #[test]
    fn metres_are_those_of_the_ground() {
        let ground = |globe: &Globe, x: f64, y: f64, along: DVec2| {
            globe.ground_metres(DVec3::new(x, y, 0.0), along).unwrap()
        };
        let utm = globe("+proj=utm +zone=32 +datum=WGS84", [0.0; 2], 1.0).unwrap();
        for along in [DVec2::X, DVec2::Y] {
            assert!((ground(&utm, 500_000.0, 5e6, along) - 1.0 / 0.9996).abs() < 1e-6);
        }
        // At 60 degrees Mercator's metres are half as long: its sphere and the ellipsoid differ by some thousandths.
        let mercator = "+proj=merc +a=6378137 +b=6378137 +lon_0=0 +nadgrids=@null +no_defs";
        let mercator = globe(mercator, [0.0; 2], 1.0).unwrap();
        assert!((ground(&mercator, 0.0, 8_399_737.9, DVec2::X) - 0.5).abs() < 0.002);
        // On the Moon, along a circle of latitude of a plate that is true at the equator.
        let moon = globe("+proj=eqc +lat_ts=0 +R=1737400", [0.0; 2], 1.0).unwrap();
        let y = 1_737_400.0 * 60f64.to_radians();
        assert!((ground(&moon, 0.0, y, DVec2::X) - 0.5).abs() < 1e-6);
        assert!((ground(&moon, 0.0, y, DVec2::Y) - 1.0).abs() < 1e-6);
    }
}
