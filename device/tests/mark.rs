//! The mark of an image.

use device::mark::{Mark, bytes, parse};
use protocol::system::DeviceKind;

#[test]
fn a_mark_is_read_as_it_was_written() {
    for machine in [DeviceKind::Rig, DeviceKind::Capsule] {
        let mark = bytes(machine);
        let read = parse(&mark).expect("a mark");
        assert_eq!((read.machine, read.protocol), (machine, protocol::VERSION));
        assert_eq!(read.schema_key, protocol::table::SCHEMA_KEY);
        // A section may be longer, but not shorter or of another layout.
        assert_eq!(parse(&[&mark[..], &[0; 8]].concat()), Some::<Mark>(read));
        assert_eq!(parse(&mark[..23]), None);
        for byte in [7, 8] {
            let mut other = mark;
            other[byte] = 9;
            assert_eq!(parse(&other), None);
        }
    }
}
